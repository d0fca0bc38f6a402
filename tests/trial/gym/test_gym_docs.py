"""The programs of docs/gym.md for RemoteEnv do what they say."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from testing.gym_server import gym_server

ROOT = Path(__file__).parents[3]
COUNT = 3
PROGRAMS = [
    found for found in re.findall(r"```python\n(.*?)```", (ROOT / "docs/gym.md").read_text(), re.S) if "Remote" in found
]


@pytest.mark.parametrize("at", range(COUNT))
def test_the_programs_run(at: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert len(PROGRAMS) == COUNT
    with gym_server() as server:
        names: dict[str, object] = {}
        exec(PROGRAMS[at].replace("127.0.0.1:5000", f"127.0.0.1:{server.port}"), names)
    if at == 0:
        assert names["most"] == 500
        assert capsys.readouterr().out == "500 steps\n"
