"""Where the researcher's folder stands on the path, and which of its files would hide what servers need."""

from __future__ import annotations

import sysconfig
from importlib import metadata
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from hippodrome.protocol.server_modules import SERVER_MODULES
from hippodrome.trial.agent.loading import with_folders

ROOT = Path(__file__).resolve().parents[3]
CLONE, LIBRARY = str(ROOT), sysconfig.get_path("stdlib")
PYTHON = ["/usr/lib/python.zip", LIBRARY, f"{LIBRARY}/lib-dynload"]


def test_the_folder_is_behind_python_and_before_packages_and_the_clone() -> None:
    assert with_folders([*PYTHON, "/site-packages"], ["/study"]) == [*PYTHON, "/study", "/site-packages"]
    path = [CLONE, "/mine", *PYTHON, "/site-packages"]
    assert with_folders(path, ["/study"]) == ["/mine", *PYTHON, "/study", CLONE, "/site-packages"]


def test_a_study_that_lies_in_the_clone_itself_is_there_too() -> None:
    assert with_folders([CLONE, *PYTHON, "/site-packages", CLONE], [CLONE]) == [*PYTHON, CLONE, "/site-packages"]


def test_a_folder_is_added_once() -> None:
    path = with_folders([*PYTHON, "/site-packages"], ["/study"])
    assert with_folders(path, ["/study/scripts", "/study"]) == [*PYTHON, "/study/scripts", "/study", "/site-packages"]


def test_all_modules_of_the_servers_requirements_are_known() -> None:
    waiting = [line for line in (ROOT / "requirements/trial.txt").read_text().splitlines() if line[:1] not in {"", "#"}]
    packages: set[str] = set()
    while waiting:
        requirement = Requirement(waiting.pop())
        name = canonicalize_name(requirement.name)
        if name not in packages and (not requirement.marker or requirement.marker.evaluate({"extra": ""})):
            packages.add(name)
            waiting += metadata.requires(name) or ()
    modules = metadata.packages_distributions().items()
    needed = {module for module, owners in modules if packages & set(map(canonicalize_name, owners))}
    assert {module for module in needed if not module.startswith("_")} == set(SERVER_MODULES) - {"onnxruntime"}
