"""A study's requirements.txt is installed by the commands for one machine: once for each content."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Problem
from hippodrome.local import requirements

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """A study that needs the package `grove`, which pip finds in the folder `wheels` and nowhere else."""
    wheels, folder = tmp_path / "wheels", tmp_path / "study"
    wheels.mkdir()
    for version in ("1.0", "2.0"):
        with zipfile.ZipFile(wheels / f"grove-{version}-py3-none-any.whl", "w") as wheel:
            about = f"grove-{version}.dist-info"
            wheel.writestr("grove.py", f"VERSION = {version!r}\n")
            wheel.writestr(f"{about}/METADATA", f"Metadata-Version: 2.1\nName: grove\nVersion: {version}\n")
            wheel.writestr(f"{about}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
            wheel.writestr(f"{about}/RECORD", "")
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text("project:\n  id: grove\n  steps: {1: hello}\n")
    (folder / "agent.py").write_text("import grove\n")
    (folder / "requirements.txt").write_text("grove\n")
    (tmp_path / "image.txt").write_text("grove==1.0\n")
    return folder


def installing(study: Path) -> str:
    """Run the command. Returns its output. pip installs into the folder `there`."""
    place = study.parent
    env = {
        **os.environ,
        "PIP_NO_INDEX": "1",
        "PIP_FIND_LINKS": str(place / "wheels"),
        "PIP_TARGET": str(place / "there"),
        "PIP_UPGRADE": "1",
        "PYTHONPATH": str(ROOT),
    }
    run = (
        "from hippodrome.local.requirements import prepare; from pathlib import Path; import sys; "
        "prepare(*map(Path, sys.argv[1:]))"
    )
    ran = subprocess.run(
        [sys.executable, "-c", run, study, place / "image.txt", place / "stamps"],
        cwd=place,
        env=env,
        capture_output=True,
        text=True,
        check=True,
    )
    return ran.stdout


def installed(study: Path) -> str:
    return (study.parent / "there" / "grove.py").read_text()


def test_packages_are_installed_once(study: Path) -> None:
    assert installing(study) == f"Installing what {study}/requirements.txt names (once) …\n"
    assert "1.0" in installed(study), "the version of the servers' image"
    assert installing(study) == ""


def test_a_changed_file_is_installed_again(study: Path) -> None:
    installing(study)
    (study.parent / "image.txt").write_text("")
    assert "Installing" in installing(study)
    assert "2.0" in installed(study)


def test_a_failed_installation_is_reported_each_time_without_an_error(study: Path) -> None:
    (study / "requirements.txt").write_text("a-package-that-is-nowhere\n")
    for _ in range(2):
        assert "Not everything that" in installing(study)


def test_requirements_of_a_clone_of_hippo_gym_are_not_installed(study: Path) -> None:
    """Its file names versions for Python 3.7."""
    (study / "steps").rename(study / "StepFiles")
    assert installing(study) == ""


def test_an_unreadable_study_is_left_to_the_next_command(study: Path) -> None:
    (study / "config.yml").unlink()
    assert installing(study) == ""


def test_a_python_that_is_no_virtual_environment_is_not_changed(
    study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.base_prefix", sys.prefix)
    requirements.prepare(study)
    said = capsys.readouterr().out
    assert f"This Python lacks grove, which {study}/requirements.txt names" in said
    assert f"-m pip install -r {study}/requirements.txt" in said


def test_nothing_is_said_if_a_python_has_everything(
    study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.base_prefix", sys.prefix)
    lines = ["# ours", "--no-index", "typer>=0.1  # a comment", "none; python_version < '3'"]
    (study / "requirements.txt").write_text("\n".join(lines))
    requirements.prepare(study)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("command", ["run", "try", "check"])
def test_the_commands_for_one_machine_install_first(command: str, study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folders = []

    def prepare(folder: Path) -> None:
        folders.append(folder)
        raise Problem("that is enough")

    monkeypatch.setattr(requirements, "prepare", prepare)
    assert main([command, str(study)]) == 1
    assert folders == [study]


def test_our_package_tests_is_imported_before_an_installed_one(tmp_path: Path) -> None:
    """`slimevb` installs a package `tests`; a folder without a file of its own would come after it."""
    (tmp_path / "tests").mkdir()
    (tmp_path / "tests" / "__init__.py").touch()
    found = subprocess.run(
        [sys.executable, "-c", "import tests; print(tests.__file__)"],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert Path(found.strip()) == ROOT / "tests" / "__init__.py"
