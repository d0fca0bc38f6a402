"""The targets for one machine hand their variables on, and say so if there is no such variable."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def make(*arguments: str, **environment: str) -> str:
    """What make would run, and what it says."""
    env = {name: value for name, value in os.environ.items() if name not in ("HOST", "DATA", "MAKEFLAGS", "MAKELEVEL")}
    ran = subprocess.run(
        ["make", "-n", *arguments], cwd=ROOT, env={**env, **environment}, capture_output=True, text=True, check=True
    )
    return ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (("run", "HOST=0.0.0.0", "PORT=1"), r'-m local "\." --data "\./data" --port 1 --host "0\.0\.0\.0"'),
        (("run", "ARGS=--fresh"), r"-m local .* --fresh"),
        (("try", "DATA=/x", "BOTS=3"), r'-m local\.rehearsal "\." --bots 3 --data "/x"'),
        (("data", "PROJECT=../a", "DATA=/x"), r'-m deploy data --project "\.\./a/" --from "/x"'),
    ],
)
def test_variables_reach_the_command(arguments: tuple[str, ...], wanted: str) -> None:
    assert re.search(wanted, make(*arguments))


def test_what_nobody_has_given_is_not_handed_on() -> None:
    assert "--host" not in make("run", HOST="x86_64-conda-linux-gnu")  # a compiler's, in the environment
    assert "--data" not in make("try")
    assert "--from" not in make("data", "PROJECT=../a")


def test_a_variable_that_does_not_exist_is_said() -> None:
    assert "There is no variable PROJCT here" in make("run", "PROJCT=../a")
    assert "There is no variable" not in make("run", "PROJECT=../a", "PYTHON=python3", "ARGS=--fresh")
    assert "There is no variable" not in make("hunt", "SEED=3", "TIMES=2", "WORKERS=1")


def test_every_variable_of_the_makefile_is_known() -> None:
    text = (ROOT / "Makefile").read_text()
    (known,) = re.findall(r"^KNOWN := (.*)$", text, re.MULTILINE)
    given = set(re.findall(r"^([A-Z]+) \?=", text, re.MULTILINE))
    assert given
    assert given <= set(known.split())
