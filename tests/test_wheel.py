"""Hippodrome from a wheel, in an environment and a folder that know nothing of the clone."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PLACES = """
import sys
from hippodrome import places
from hippodrome.deployment.code import build, packages
from hippodrome.deployment.study.image.bundle import make_bundle
from pathlib import Path
assert not places.IS_CLONE
names = sorted(path.stem for path in (places.ROOT / "lambdas").glob("*.py") if path.stem != "__init__")
tree = build._Tree(places.ROOT)
assert tree.handlers() == names
members = {member.name for member in tree.files("hippodrome.control.participants.frame")}
assert {"hippodrome/control/participants/frame.py", "hippodrome/web/frame.html"} <= members, members
assert [member.name for member in tree.files("lambdas.sweep")] == ["lambdas/sweep.py"]
bundle = make_bundle(Path("maze"))
assert {"Dockerfile", "hippodrome/trial/__main__.py", "requirements/trial.txt", "project/agent.py"} <= set(bundle.entries)
outside = [name for name, module in sys.modules.items() if (getattr(module, "__file__", None) or "").startswith(sys.argv[1])]
assert not outside, outside
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        ".",
        "--quiet",
        "--no-deps",
        "--no-build-isolation",
        "-w",
        str(folder),
    ]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    (file,) = folder.glob("*.whl")
    return file


@pytest.fixture(scope="module")
def environment(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A virtual environment with the wheel. It sees the packages that are installed here, and not the clone."""
    folder = tmp_path_factory.mktemp("venv")
    venv.create(folder, with_pip=False, symlinks=True)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")  # the .pth files there are not read
    install = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        str(folder / "bin" / "python"),
        "install",
        "--quiet",
        "--no-deps",
    ]
    subprocess.run([*install, "--no-index", str(wheel)], check=True, capture_output=True, text=True)
    return folder


def run(environment: Path, folder: Path, *command: str) -> str:
    """Run a program of the environment in this folder, and return what it printed."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "HIPPODROME"))}
    path = os.pathsep.join([str(environment / "bin"), kept.get("PATH", "")])
    done = subprocess.run(
        [str(environment / "bin" / command[0]), *command[1:]],
        cwd=folder,
        env={**kept, "PATH": path, "COLUMNS": "150", "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=150,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_the_wheel_holds_one_package(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        tops = {name.split("/")[0] for name in archive.namelist()}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"hippodrome"}


def test_a_study_is_made_checked_rehearsed_and_read_far_from_the_clone(environment: Path, tmp_path: Path) -> None:
    templates = run(environment, tmp_path, "hippodrome", "new")
    assert "overcooked" in templates
    run(environment, tmp_path, "hippodrome", "new", "maze", "gridworld")
    assert "No mistakes" in run(environment, tmp_path, "hippodrome", "check", "maze")
    tried = run(environment, tmp_path, "hippodrome", "try", "maze", "--bots", "2", "--play", "2")
    assert re.search(r"errors\s*│ none", tried), tried
    (data,) = (tmp_path / "maze" / "data-try").glob("try-*")
    run(environment, tmp_path, "hippodrome", "data", "maze", "--from", str(data))
    assert list(tmp_path.glob("**/answers.csv"))
    run(environment, tmp_path, "python", "-c", PLACES, str(ROOT))
