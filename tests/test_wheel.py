"""Hippodrome from a wheel, in an environment and a folder that know nothing of the clone."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
import sysconfig
import venv
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from hippodrome.deployment.code import build
from hippodrome.deployment.code.packages import Target, read_pins
from hippodrome.deployment.study.image.bundle import make_bundle

ROOT = Path(__file__).resolve().parent.parent
# Each process of the environment imports it first, also the study's own and the participants' servers.
READS_NOTHING_OF_THE_CLONE = f"""
import os, sys
CLONE, PACKAGES = {str(ROOT)!r} + os.sep, {sys.prefix!r} + os.sep
def refuse(event, arguments):
    if event in ("open", "os.listdir", "os.scandir") and isinstance(arguments[0], str):
        path = os.path.abspath(arguments[0])
        if path.startswith(CLONE) and not path.startswith(PACKAGES):
            raise RuntimeError(path + " belongs to the clone")
sys.addaudithook(refuse)
"""
ZIPS_AND_IMAGE = """
import json, sys
from pathlib import Path
from hippodrome.deployment.code import build
from hippodrome.deployment.code.packages import Target
from hippodrome.deployment.study.image.bundle import make_bundle
functions = build.functions(Target())
(sweep,) = (function for function in functions if function.name == "sweep")
Path("sweep.zip").write_bytes(sweep.pack())
image = make_bundle(Path("maze"))
image.write_folder(Path("image"))
print(json.dumps({"functions": [function.key for function in functions], "image": image.hash}))
"""
WITHOUT_BOTO3 = """
import sys
sys.modules |= {"boto3": None, "botocore": None}
from hippodrome.cli import main
sys.exit(main())
"""
_PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [*_PIP, "wheel", ".", "--no-deps", "--no-build-isolation", "--wheel-dir", str(folder)]
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
    install = [*_PIP, "--python", str(folder / "bin" / "python"), "install", "--no-deps", "--no-index", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, text=True)
    (site / "guard.py").write_text(READS_NOTHING_OF_THE_CLONE)
    (site / "guard.pth").write_text("import guard\n")
    return folder


def run(environment: Path, folder: Path, *command: str, fails: bool = False) -> str:
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
    assert bool(done.returncode) is fails, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stderr if fails else done.stdout


@pytest.fixture(scope="module")
def studies(environment: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the study maze."""
    folder = tmp_path_factory.mktemp("studies")
    run(environment, folder, "hippodrome", "new", "maze", "gridworld")
    return folder


def test_the_wheel_holds_one_package_and_no_caches_or_data(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        files = [Path(name) for name in archive.namelist()]
    tops = {file.parts[0] for file in files}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"hippodrome"}
    assert not [file for file in files if {"__pycache__", "data", "shots"} & set(file.parts) or file.suffix == ".pyc"]


def test_the_wheel_requires_what_make_installs(wheel: Path) -> None:
    """By extra, the names are those of requirements/, and the versions there are allowed."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        headers = HeaderParser().parsestr(archive.read(name).decode()).get_all("Requires-Dist")
    required = [Requirement(line) for line in headers or () if not line.startswith("hippodrome")]
    pins = {name: read_pins(ROOT / f"requirements/{name}.txt") for name in ("lambdas", "trial", "local", "deploy")}
    of_a_study = pins["lambdas"] | pins["trial"] | pins["local"]
    assert {one.name for one in required if one.marker is None} == of_a_study.keys()
    assert {one.name for one in required if one.marker is not None} == pins["deploy"].keys()
    for one in required:
        assert one.specifier.contains((of_a_study | pins["deploy"])[one.name].version), one


def test_the_clone_is_out_of_reach(environment: Path, tmp_path: Path) -> None:
    reads = f"open({str(ROOT / 'hippodrome' / 'cli.py')!r})"
    assert "belongs to the clone" in run(environment, tmp_path, "python", "-c", reads, fails=True)
    where = run(environment, tmp_path, "python", "-c", "import hippodrome.cli; print(hippodrome.cli.__file__)")
    assert Path(where).is_relative_to(environment)
    for name in ("lambdas", "testing", "deploy", "bundled"):
        assert "ModuleNotFoundError" in run(environment, tmp_path, "python", "-c", f"import {name}", fails=True)


def test_every_template_is_there_and_its_links_lead_to_files(environment: Path, studies: Path) -> None:
    examples = {file.parent.name for file in ROOT.glob("examples/*/config.yml")}
    listed = run(environment, studies, "hippodrome", "new")
    assert examples < {line.split()[0] for line in listed.splitlines() if line.startswith("  ")}
    links = re.findall(r"\]\((\.\./[^)#\s]+)", (studies / "maze" / "README.md").read_text())
    assert links
    for link in links:
        assert (studies / "maze" / link).is_file(), link


def test_a_study_is_checked_rehearsed_and_read(environment: Path, studies: Path) -> None:
    assert "No mistakes" in run(environment, studies, "hippodrome", "check", "maze")
    tried = run(environment, studies, "hippodrome", "try", "maze", "--bots", "2", "--play", "2")
    assert re.search(r"errors\s*│ none", tried), tried
    (data,) = (studies / "maze" / "data-try").glob("try-*")
    without_boto3 = ("python", "-c", WITHOUT_BOTO3)
    run(environment, studies, *without_boto3, "data", "maze", "--from", str(data))
    (answers,) = (studies / "maze").glob("data-*/**/answers.csv")
    first, second = participants(answers)
    run(environment, studies, *without_boto3, "erase", first, "maze", "--from", str(data), "--yes")
    run(environment, studies, *without_boto3, "data", "maze", "--from", str(data))
    assert participants(answers) == [second]
    on_aws = run(environment, studies, *without_boto3, "data", "maze", "--aws", fails=True)
    assert 'pip install "hippodrome[aws]"' in on_aws


def participants(answers: Path) -> list[str]:
    with answers.open(newline="") as file:
        return [row["participant"] for row in csv.DictReader(file)]


def test_the_functions_and_the_image_are_those_of_the_clone(environment: Path, studies: Path) -> None:
    made = json.loads(run(environment, studies, "python", "-c", ZIPS_AND_IMAGE))
    assert made["functions"] == [function.key for function in build.functions(Target())]
    assert made["image"] == make_bundle(studies / "maze").hash
    with zipfile.ZipFile(studies / "sweep.zip") as archive:
        assert {"lambdas/sweep.py", "hippodrome/__init__.py"} <= set(archive.namelist())
    assert (studies / "image" / "hippodrome" / "trial" / "__main__.py").is_file()
