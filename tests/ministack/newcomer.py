"""Somebody with a new AWS account and a clone of Hippodrome, who types what docs/first-hour.md says."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from testing.ministack.world import REGION, ROOT, MinistackWorld
from tests.certificate import pebble
from tests.certificate.nameserver import answering

DOMAIN = "play.example.org"
QUESTION = "type the stack's name:"


@dataclass(frozen=True)
class Newcomer:
    """`types` runs a line in the shell, in the clone. `internet` is what DNS says, by name and type of record."""

    world: MinistackWorld
    folder: Path
    env: dict[str, str]
    internet: dict[tuple[str, str], Sequence[str]]

    def types(self, line: str, answer: str = "", seconds: float = 280) -> tuple[int, str]:
        """Return the exit code, and all that was printed. `answer` is typed, at a terminal, when the command asks."""
        keyboard, terminal = pty.openpty()
        try:
            os.write(keyboard, f"{answer}\n".encode())
            ended = subprocess.run(
                ["bash", "-c", line],
                cwd=self.folder,
                env=self.env,
                stdin=terminal if answer else subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                timeout=seconds,
                check=False,
            )
        finally:
            os.close(keyboard)
            os.close(terminal)
        # What is typed is seen at a terminal, and its end is the end of the line.
        return ended.returncode, re.sub(rf"({QUESTION}) ", rf"\1 {answer}\n", ended.stdout)


@contextlib.contextmanager
def arrived(world: MinistackWorld, home: Path) -> Iterator[Newcomer]:
    """With a hosted zone for `DOMAIN`, an administrator's keys, and nothing else."""
    made = world.client("route53").create_hosted_zone(Name=f"{DOMAIN}.", CallerReference="newcomer")
    servers = [f"{name.rstrip('.')}." for name in made["DelegationSet"]["NameServers"]]
    internet: dict[tuple[str, str], Sequence[str]] = {(DOMAIN, "NS"): servers}
    iam = world.client("iam")
    iam.create_user(UserName="admin")
    iam.attach_user_policy(UserName="admin", PolicyArn="arn:aws:iam::aws:policy/AdministratorAccess")
    keys = iam.create_access_key(UserName="admin")["AccessKey"]
    with contextlib.ExitStack() as stack:
        folders = [home / name for name in ("staging", "production")]
        for folder in folders:
            folder.mkdir(parents=True)
        staging, production = (stack.enter_context(pebble.running(folder)) for folder in folders)
        told = {
            "staging": staging.directory,
            "production": production.directory,
            "trusted": {one.directory: one.trusted for one in (staging, production)},
            "nameserver": stack.enter_context(answering(internet)),
            "dns": [one.dns_management for one in (staging, production)],
        }
        (home / "bridge.json").write_text(json.dumps(told))
        _clone(world.source)
        env = {name: os.environ[name] for name in ("LANG", "LC_ALL", "TMPDIR", "HOME") if name in os.environ}
        env |= {
            "PATH": f"{world.source / '.venv' / 'bin'}{os.pathsep}{os.environ['PATH']}",
            "BRIDGE": str(home / "bridge.json"),
            "AWS_ENDPOINT_URL": world.endpoint,
            "AWS_CA_BUNDLE": str(world.ca),
            "AWS_REGION": REGION,
            "AWS_ACCESS_KEY_ID": keys["AccessKeyId"],
            "AWS_SECRET_ACCESS_KEY": keys["SecretAccessKey"],
            "AWS_EC2_METADATA_DISABLED": "true",
            "AWS_CONFIG_FILE": os.devnull,
            "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
            "HIPPODROME_TARGET": "here",
            "PYTHONDONTWRITEBYTECODE": "",  # then the next command finds its modules compiled
            "PYTHONUTF8": "1",
            "COLUMNS": "160",
        }
        yield Newcomer(world, world.source, env, internet)


def _clone(folder: Path) -> None:
    """What `MinistackWorld` has not copied, and a virtual environment whose Python has the bridge."""
    for name in ("Makefile", ".dockerignore"):
        shutil.copy(ROOT / name, folder)
    bin = folder / ".venv" / "bin"
    bin.mkdir(parents=True)
    programs = ROOT / "testing" / "ministack"
    (bin / "python").write_text(f'#!/bin/sh\nexec "{sys.executable}" "{programs / "bridge.py"}" "$@"\n')
    (bin / "python").chmod(0o755)
    for ready in ("local", "deploy"):
        (folder / ".venv" / ready).touch()
