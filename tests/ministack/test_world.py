"""The account on the emulator: callers are checked, and the emulator ends with the tests."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import botocore.exceptions
import pytest

from testing.ministack.world import ROOT, MinistackWorld, until

pytestmark = [pytest.mark.timeout(120)]

HOLD = """
import sys, time
from pathlib import Path
from testing.ministack.world import MinistackWorld
with MinistackWorld(Path(sys.argv[1]), Path(sys.argv[2])) as world:
    print(world._process.pid, flush=True)
    time.sleep(100)
"""


def is_alive(pid: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes as Linux shows them")
def test_the_emulator_ends_when_the_tests_are_killed(world: MinistackWorld, tmp_path: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(world.venv), str(tmp_path)]
    with subprocess.Popen(
        command, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE
    ) as tests:
        assert tests.stdout is not None
        emulator = int(tests.stdout.readline())
        assert is_alive(emulator)
        tests.send_signal(signal.SIGKILL)
    until(lambda: not is_alive(emulator), "the emulator is gone")


def test_the_emulator_checks_the_callers_permissions(world: MinistackWorld) -> None:
    assert world.client("sts").get_caller_identity()["Arn"].endswith(":root")
    stranger = {"AccessKeyId": "AKIASTRANGERSTRANGER", "SecretAccessKey": "guessed"}
    with pytest.raises(botocore.exceptions.ClientError, match="InvalidAccessKeyId"):
        world.client("s3", stranger).list_buckets()
    nobody = world.user("nobody", "arn:aws:iam::aws:policy/AWSDenyAll")
    with pytest.raises(botocore.exceptions.ClientError, match="AccessDenied"):
        world.client("s3", nobody).list_buckets()
    with pytest.raises(botocore.exceptions.ClientError, match="SignatureDoesNotMatch"):
        world.client("s3", {**nobody, "SecretAccessKey": "wrong"}).list_buckets()
    iam = world.client("iam")
    iam.delete_access_key(UserName="nobody", AccessKeyId=nobody["AccessKeyId"])
    iam.detach_user_policy(UserName="nobody", PolicyArn="arn:aws:iam::aws:policy/AWSDenyAll")
    iam.delete_user(UserName="nobody")
