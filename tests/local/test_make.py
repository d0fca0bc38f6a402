"""The targets for one machine hand their variables on, and say so if there is no such variable."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


def make(*arguments: str, **environment: str) -> str:
    """Run `make -n`. Returns the commands that it would run, and its output."""
    env = {name: value for name, value in os.environ.items() if name not in ("HOST", "DATA", "MAKEFLAGS", "MAKELEVEL")}
    ran = subprocess.run(
        ["make", "-n", *arguments], cwd=ROOT, env={**env, **environment}, capture_output=True, text=True, check=True
    )
    return ran.stdout + ran.stderr


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (("run", "HOST=0.0.0.0", "PORT=1"), 'run --port "1" --host "0.0.0.0"'),
        (("run", "TLS=1", "NAMES=userId"), 'run --tls --names "userId"'),
        (("run", "ARGS=--fresh"), "run --fresh"),
        (("run", "PROJECT=../a", "DATA=/x"), 'run "../a/" --data "/x"'),
        (("try", "DATA=/x", "BOTS=3"), 'try --bots "3" --data "/x"'),
        (("check", "PROJECT=../my-clone", "ARGS=--strict"), 'check "../my-clone/" --strict'),
        (("register", "PROJECT=../my-clone", "ARGS=--strict"), 'register "../my-clone/" --strict'),
        (("data", "PROJECT=../a", "DATA=/x"), 'data "../a/" --from "/x"'),
        (
            ("deploy", "PROJECT=../a", "DOMAIN=a.org", "EMAIL=me@a.org"),
            'deploy "../a/" --domain "a.org" --email "me@a.org"',
        ),
        (("plan", "PROJECT=../a", "DOMAIN=a.org"), 'deploy "../a/" --domain "a.org" --plan'),
    ],
)
def test_variables_reach_the_command(arguments: tuple[str, ...], wanted: str) -> None:
    assert f"-m hippodrome {wanted}" in " ".join(make(*arguments).split())


def test_variables_that_are_not_given_are_not_passed_on() -> None:
    assert "--host" not in make("run", HOST="x86_64-conda-linux-gnu")  # a compiler's, in the environment
    assert "--tls" not in make("run", "TLS=0")
    assert "--tls" not in make("run", TLS="1")
    assert "--data" not in make("try")
    assert "--from" not in make("data", "PROJECT=../a")


def test_a_variable_that_is_empty_in_the_environment_counts_as_not_given() -> None:
    """Otherwise the data would be in the current folder, or below the root."""
    for name in ("DATA", "PORT", "PROJECT"):
        assert make("run", **{name: " "}).split()[-3:] == ["-m", "hippodrome", "run"]
    assert "--data" not in make("try", DATA="")
    assert "--from" not in make("data", DATA="")


def refused(*arguments: str) -> str:
    """Run `make -n`, which must run nothing. Return what it says."""
    with pytest.raises(subprocess.CalledProcessError) as failed:
        make(*arguments)
    assert failed.value.stdout == ""
    return str(failed.value.stderr)


@pytest.mark.parametrize("folder", ["../trust", "/studies/trust", "trust", "tests"])
def test_a_folder_without_project_is_refused(folder: str) -> None:
    """Else `make check ../trust` would find no mistakes in the example, and `make run ../trust` serve it."""
    for command in ("check", "run"):
        assert f"write: make {command} PROJECT={folder}." in refused(command, folder)
    assert f"write: make run PROJECT={folder}." in refused(folder)


@pytest.mark.parametrize("name", ["PROJECT", "DATA", "USER_ID", "PORT", "BOTS", "STACK"])
def test_a_variable_without_a_value_is_refused(name: str) -> None:
    """Else `make erase DATA=$FOLDER` would look in another folder if FOLDER is not set."""
    assert f"{name}= has no value, and nothing was run" in refused("data", f"{name}=")
    assert f"{name}= has no value" in refused("data", f"{name}= ")


def test_an_erasure_names_the_participant_after_all_options() -> None:
    """An id may begin with a dash."""
    erase = make("erase", "USER_ID=-a1", "PROJECT=../a", "DATA=/x", "ARGS=--yes").strip().splitlines()[-1]
    assert '-m hippodrome erase --from "/x" --yes -- "-a1" "../a/"' in " ".join(erase.split())


def test_an_unknown_variable_is_refused() -> None:
    """Nothing is run: else `make deploy PROJCT=../a` would put another study on AWS, and EMIAL= send alarms to nobody."""
    assert "There is no variable PROJCT here" in refused("run", "PROJCT=../a")
    assert "There is no variable" not in make("run", "PROJECT=../a", "PYTHON=python3", "ARGS=--fresh")
    assert "There is no variable" not in make("hunt", "SEED=3", "TIMES=2", "WORKERS=1")


@pytest.mark.parametrize("given", ["AWS_REGION=eu-west-1", "AWS_PROFILE=lab", "HIPPODROME_DEBUG=1"])
def test_what_the_commands_read_from_the_environment_may_be_given_to_make(given: str) -> None:
    assert "There is no variable" not in make("status", given)


# -- which machines ----------------------------------------------------------------------------------------------------


@pytest.fixture
def somewhere(tmp_path: Path) -> Path:
    """A clone in which nothing is installed, with the test's own `uname`, `python3` and pip."""
    (tmp_path / "Makefile").write_text((ROOT / "Makefile").read_text())
    (tmp_path / "pyproject.toml").write_text((ROOT / "pyproject.toml").read_text())
    shutil.copytree(ROOT / "requirements", tmp_path / "requirements")
    (tmp_path / "bin").mkdir()
    return tmp_path


def program(file: Path, text: str) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f"#!/bin/sh\n{text}\n")
    file.chmod(0o755)


def installing(
    place: Path, machine: str, version: tuple[int, int], pip: str = 'echo "$@" >> pip.log'
) -> tuple[int, str]:
    """`make` of what a study needs, on such a machine with such a Python; how it ended, and what it said."""
    program(place / "bin/uname", f"echo {machine}")
    asked = f"import sys; sys.version_info = ({version[0]}, {version[1]}, 0, 'final', 0);"
    made = "mkdir -p .venv/bin; cp bin/pip .venv/bin/pip; touch .venv/bin/python"
    program(place / "bin/python3", f'[ "$1" = -m ] && {{ {made}; exit; }}; exec {sys.executable} -c "{asked} $2"')
    program(place / "bin/pip", pip)
    env = {**os.environ, "PATH": f"{place / 'bin'}:{os.environ['PATH']}"}
    env = {name: value for name, value in env.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS")}
    ran = subprocess.run(["make", ".venv/deploy"], cwd=place, env=env, capture_output=True, text=True, check=False)
    return ran.returncode, ran.stdout + ran.stderr


def installed(place: Path) -> dict[str, str]:
    """Return the lines of the requirements that pip was given, by the names of the packages."""
    lines: list[str] = []

    def read(file: Path) -> None:
        for line in file.read_text().splitlines():
            if line.startswith("-r "):
                read(file.parent / line[3:])
            elif line and not line.startswith("#"):
                lines.append(line)

    for call in (place / "pip.log").read_text().splitlines():
        if " -r " in call:
            read(place / call.rpartition(" -r ")[2])
    return {line.partition("==")[0]: line for line in lines}


def test_the_pinned_packages_are_installed(somewhere: Path) -> None:
    code, said = installing(somewhere, "Linux x86_64", (3, 14))
    assert code == 0, said
    assert installed(somewhere)["ale-py"] == "ale-py==0.12.1"
    calls = (somewhere / "pip.log").read_text().splitlines()
    assert all("-c requirements/constraints.txt" in call for call in calls)
    assert any(call.endswith(" --no-deps --editable .") for call in calls)
    assert all("--only-binary ale-py,cryptography," in call for call in calls if " -r " in call)


def pinned(*names: str) -> dict[str, str]:
    """Return the lines of these files of requirements, by package."""
    lines = [line for name in names for line in (ROOT / f"requirements/{name}.txt").read_text().splitlines()]
    return {line.partition("==")[0]: line for line in lines if "==" in line}


def test_intel_macs_get_the_last_versions_that_have_wheels_for_them(somewhere: Path) -> None:
    code, said = installing(somewhere, "Darwin x86_64", (3, 13))
    assert code == 0, said
    usual, older = pinned("lambdas", "trial", "local", "deploy"), pinned("intel-mac")
    assert older.keys() <= usual.keys() | pinned("dev").keys()
    assert installed(somewhere) == usual | {name: line for name, line in older.items() if name in usual}


@pytest.mark.parametrize(
    ("machine", "version", "range_"),
    [
        ("Linux x86_64", (3, 10), "3.11 to 3.14"),
        ("Darwin arm64", (3, 15), "3.11 to 3.14"),
        ("Darwin x86_64", (3, 14), "3.11 to 3.13"),
    ],
)
def test_an_unsupported_python_is_refused_before_anything_is_installed(
    somewhere: Path, machine: str, version: tuple[int, int], range_: str
) -> None:
    code, said = installing(somewhere, machine, version)
    assert code != 0
    assert f"Hippodrome needs Python {range_} on this machine ({machine})" in said
    assert f"try: make PYTHON=python{range_[-4:]} .venv/deploy" in said
    assert not (somewhere / ".venv").exists()


def test_a_failed_installation_is_reported_in_a_sentence(somewhere: Path) -> None:
    no_wheel = "echo 'ERROR: No matching distribution found for h5py==3.16.0' >&2; exit 1"
    code, said = installing(somewhere, "FreeBSD amd64", (3, 13), no_wheel)
    assert code != 0
    assert "No matching distribution found for h5py" in said
    assert "There are packages for Linux (x86-64 and ARM) and macOS" in said


def test_every_variable_of_the_makefile_is_known() -> None:
    text = (ROOT / "Makefile").read_text()
    (known,) = re.findall(r"^KNOWN := (.*)$", text, re.MULTILINE)
    given = set(re.findall(r"^([A-Z]+) \?=", text, re.MULTILINE))
    assert given
    assert given <= set(known.split())
