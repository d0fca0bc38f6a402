"""A server on a port of its task definition, in a container's network namespace and without any capability.

What Fargate does with `systemControls`, `user` and `capabilities` is done here by `unshare` and `setpriv`: the kernel is
the same. Whether Fargate does it stands in docs/unproven.md.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from hippodrome.deployment.aws.account import Installation
from hippodrome.deployment.study.definition import definition
from hippodrome.protocol import exits
from tests.trial.conftest import ROOT, grid_agent

# The program runs beside a client that asks for /healthz until it is answered, and then ends the program.
CLIENT = """
import http.client, os, signal, subprocess, sys, time
port, command = int(sys.argv[1]), sys.argv[2:]
server = subprocess.Popen(command, stdout=subprocess.DEVNULL)
status = None
for _ in range(1200):
    if server.poll() is not None:
        break
    try:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=2)
        connection.request("GET", "/healthz")
        status = connection.getresponse().status
        break
    except OSError:
        time.sleep(0.1)
rights = "gone"
if server.poll() is None:
    lines = open(f"/proc/{server.pid}/status").read().splitlines()
    rights = {line.split()[1] for line in lines if line.startswith(("CapPrm", "CapEff", "CapBnd", "CapInh", "CapAmb"))}
    rights = ",".join(sorted(rights))
    server.send_signal(signal.SIGKILL)
print(status, rights, server.wait())
"""
OUTER = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--user", "--map-root-user", "--net"]
TOOLS = ("unshare", "setpriv", "ip")
missing = [tool for tool in TOOLS if shutil.which(tool) is None]
if not missing and subprocess.run([*OUTER, "true"], capture_output=True, check=False).returncode:
    missing = ["network namespaces"]
pytestmark = pytest.mark.skipif(bool(missing), reason=f"needs {', '.join(missing)}")


def container(port: str) -> dict[str, Any]:
    """Return the container in a study's task definition, in an installation with that ServerPort."""
    names = ("TaskExecutionRole", "TaskRole", "TrialLogGroup")
    installation = Installation(
        "hippodrome", "us-east-1", "CREATE_COMPLETE", {**dict.fromkeys(names, "x"), "ServerPort": port}
    )
    (found,) = definition(installation, "maze", "image", 1, 2)["containerDefinitions"]
    return dict(found)


def run(folder: Path, said: dict[str, Any]) -> list[str]:
    """Run a trial server as this container does; return the status of its /healthz, its capabilities and its exit status."""
    (folder / "agent.py").write_text(grid_agent())
    port = said["portMappings"][0]["containerPort"]
    sets = [
        f"echo {one['value']} > /proc/sys/{one['namespace'].replace('.', '/')}"
        for one in said.get("systemControls", ())
    ]
    assert said["linuxParameters"]["capabilities"] == {"drop": ["ALL"]}
    dropped = ["setpriv", "--bounding-set=-all", "--inh-caps=-all", "--no-new-privs"]
    settings = {
        **{"PROJECT_ID": "maze", "USER_ID": "P1", "SERVER": "a1", "TOKEN": "the-token", "GAME_STEPS": "3"},
        **{"STORE": str(folder / "store"), "TRIAL": json.dumps({"game": "grid"}), "TLS": "off"},
        **{"HOST": "0.0.0.0", "PORT": str(port), "AGENT_DIR": str(folder), "PYTHONPATH": str(ROOT)},
    }
    script = " && ".join(["ip link set lo up", *sets, 'exec "$@"'])
    command = [*OUTER, "sh", "-c", script, "sh", sys.executable, "-c", CLIENT, str(port)]
    done = subprocess.run(
        [*command, *dropped, sys.executable, "-m", "hippodrome.trial"],
        cwd=folder,
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        timeout=170,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


def test_it_listens_on_443_without_any_capability(tmp_path: Path) -> None:
    status, rights, _ = run(tmp_path, container("443"))
    assert (status, rights) == ("200", "0000000000000000")


@pytest.mark.parametrize("port", ["80", "5000"])  # the authority asks for a server's proof on port 80
def test_it_listens_on_80_and_5000_without_any_capability(tmp_path: Path, port: str) -> None:
    status, rights, _ = run(tmp_path, container(port))
    assert (status, rights) == ("200", "0000000000000000")


def test_where_it_may_not_listen_its_exit_code_says_so(tmp_path: Path) -> None:
    said = container("443")
    del said["systemControls"]
    assert run(tmp_path, said) == ["None", "gone", str(exits.NO_PORT)]
