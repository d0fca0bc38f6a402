"""The tests that Gymie's client brings, unchanged, against this server.

They need Node and the client, and are skipped without:

    git clone -b v0.5.1 https://github.com/jscriptcoder/Gymie-Client.git && cd Gymie-Client
    npm install --ignore-scripts
    GYMIE_CLIENT=$PWD .venv/bin/python -m pytest tests/trial/gym/test_gymies_client.py
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from testing.gym_server import gym_server

CLIENT = os.environ.get("GYMIE_CLIENT")
ADDRESS = "0.0.0.0:5000"  # that its tests name

pytestmark = [
    pytest.mark.skipif(CLIENT is None, reason="GYMIE_CLIENT names no folder with Gymie's client"),
    pytest.mark.skipif(shutil.which("npx") is None, reason="Node is not installed"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The client as it is, with the port of a server in its tests."""
    found = tmp_path_factory.mktemp("client")
    source = Path(CLIENT or "")
    with gym_server() as server:
        shutil.copytree(source / "src", found / "src")
        shutil.copy(source / "tsconfig.json", found)
        (found / "node_modules").symlink_to(source / "node_modules")
        for tests in (found / "src").glob("*.test.ts"):
            tests.write_text(tests.read_text().replace(ADDRESS, f"0.0.0.0:{server.port}"))
        yield found


@pytest.mark.parametrize(("name", "checks"), [("Gymie", 4), ("Env", 24)])
def test_the_clients_own_tests_pass(folder: Path, name: str, checks: int) -> None:
    command = ["npx", "ts-node", "-T", f"src/{name}.test.ts"]
    found = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert re.findall(r"^# (?:pass|fail) .*", found.stdout, re.M) == [f"# pass  {checks}"], found.stdout
