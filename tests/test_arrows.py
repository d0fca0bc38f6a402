"""Which package may import which (docs/architecture.md): nothing imports uphill, and the picture there shows what is."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ET
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from testing.imports import imported

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = ROOT / "hippodrome"
MAY: dict[str, set[str]] = {
    "protocol": set(),
    "console": set(),
    "control": {"places", "protocol"},
    "functions": {"control"},
    "trial": {"protocol"},
    "export": {"console", "control", "protocol"},
    "bots": {"control", "protocol", "trial"},
    "local": {"places", "console", "control", "functions", "protocol", "bots", "trial"},
    "deployment": {"places", "console", "export", "control", "functions", "protocol", "bots", "trial"},
}
"""Which packages of `hippodrome` a package may import, and `places.py`."""
AROUND = {
    "lambdas": {"functions"},
    "deploy": {"cli", "deployment"},
    "testing": {"places", "deployment", "control", "functions", "local", "protocol", "trial"},
    "bench": {"places", "deployment", "control", "functions", "protocol", "trial"},
}
"""The same for the packages beside it."""
ROOMS = {
    "control": (
        *(
            "ports",
            "model",
            "log",
            "storage",
            "certificates",
            "limits",
            "http",
            "lobby",
            "servers",
            "participants",
            "config",
        ),
        *("aws", "metrics", "registry"),
    ),
    "trial": (
        "settings",
        "pictures",
        "core",
        "recordings",
        "llm",
        "agent",
        "policies",
        "wire",
        "gym",
        "server",
        "check",
        "interactive_gym",
    ),
    "deployment": ("aws", "core", "code", "cost", "stack", "study", "operate", "lifecycle"),
}
"""Rooms and modules of a package: each imports only from itself and from those before it."""


def packages(folder: Path) -> dict[str, str]:
    """Return the packages of ours that those in the folder import, each with a file that does."""
    found = {}
    for path in folder.rglob("*.py"):
        for name in imported(path):
            top, _, rest = name.partition(".")
            inner = rest.partition(".")[0]
            if top == "hippodrome" and inner and folder != PRODUCT / inner:
                found[inner] = path.name
            elif top in {*AROUND, "tests"} - {folder.name}:
                found[top] = path.name
    return found


def test_every_package_has_its_arrows() -> None:
    assert {path.parent.name for path in PRODUCT.glob("*/__init__.py")} == set(MAY)


@pytest.mark.parametrize("package", MAY)
def test_nothing_imports_uphill(package: str) -> None:
    found = packages(PRODUCT / package)
    assert {other: file for other, file in found.items() if other not in MAY[package]} == {}


@pytest.mark.parametrize("package", AROUND)
def test_packages_beside_the_product_use_only_these_of_it(package: str) -> None:
    found = packages(ROOT / package)
    assert {other: file for other, file in found.items() if other not in AROUND[package] | {"testing"}} == {}


def test_the_client_of_environments_imports_no_server() -> None:
    """`from hippodrome.gym import RemoteEnv` runs where a program trains."""
    loaded = "import sys, hippodrome.gym; print(*(name for name in sys.modules if name.startswith('hippodrome.')))"
    modules = subprocess.run(
        [sys.executable, "-c", loaded], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    client = ("forms", "remote", "spaces", "values")
    trial = {
        "hippodrome.gym",
        "hippodrome.trial",
        "hippodrome.trial.gym",
        *(f"hippodrome.trial.gym.{one}" for one in client),
    }
    assert set(modules.split()) == trial


def test_only_tests_of_the_bench_import_it() -> None:
    importing = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "tests").rglob("*.py")
        if any(name.partition(".")[0] == "bench" for name in imported(path))
    }
    assert importing == {"tests/bench/test_bench.py"}


def test_every_folder_of_deployment_has_its_rank() -> None:
    assert {path.parent.name for path in (PRODUCT / "deployment").glob("*/__init__.py")} == set(ROOMS["deployment"])


@pytest.mark.parametrize(("package", "room"), [(package, room) for package, rooms in ROOMS.items() for room in rooms])
def test_no_folder_imports_from_one_above(package: str, room: str) -> None:
    rooms, place = ROOMS[package], PRODUCT / package / room
    may = rooms[: rooms.index(room) + 1]
    wrong = {
        f"{path.relative_to(ROOT)} imports {name}"
        for path in (place.rglob("*.py") if place.is_dir() else [place.with_suffix(".py")])
        for name in imported(path)
        if name.startswith(f"hippodrome.{package}.") and name.split(".")[2] not in may
    }
    assert wrong == set()


@pytest.mark.parametrize("package", ["hippodrome", *AROUND])
def test_no_files_import_each_other_in_a_circle(package: str) -> None:
    """Imports for types count, too: who reads one file of a circle has to read all of them."""
    files = (ROOT / package).rglob("*.py")
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}
    arrows = {
        name: {other for other in imported(path) & modules.keys() if not f"{name}.".startswith(f"{other}.")}
        for name, path in modules.items()  # without those to the packages that a module is in
    }
    circle: list[str] = []
    try:
        TopologicalSorter(arrows).prepare()
    except CycleError as error:
        circle = error.args[1]
    assert circle == []


def loaded(module: str) -> dict[str, str]:
    """Return every module that is loaded with one of ours, each with the one of ours that imports it."""
    found, todo = {module: ""}, [module]
    while todo:
        path = ROOT / todo[-1].replace(".", "/")
        name, files = todo.pop(), [path / "__init__.py", path.with_suffix(".py")]
        for other in {each for file in files if file.is_file() for each in imported(file)} - set(found):
            found[other] = name
            if other.partition(".")[0] == "hippodrome":
                todo.append(other)
    return found


@pytest.mark.parametrize("module", ["hippodrome.local.run", "hippodrome.local.check.command"])
def test_only_processes_of_servers_and_agents_load_numpy(module: str) -> None:
    """It takes a third as long to load as all the rest, and `make run` and `make check` need it only there."""
    assert loaded(module).get("numpy") is None


def test_the_picture_shows_the_packages_and_what_they_import() -> None:
    picture = ET.parse(ROOT / "docs" / "packages.svg").getroot()
    shown = {element.get("data-room", "") for element in picture.iter() if element.get("data-room")}
    inner = {
        f"{one}/{path.parent.name}"
        for one in ("control", "deployment")
        for path in (PRODUCT / one).glob("*/__init__.py")
    }
    assert shown == MAY.keys() | inner
    arrows = {
        (element.get("data-from"), element.get("data-to")) for element in picture.iter() if element.get("data-from")
    }
    leads = {package: packages(PRODUCT / package).keys() & MAY.keys() for package in MAY}
    further = {
        a: {c for b in leads[a] for c in leads[b]} | {d for b in leads[a] for c in leads[b] for d in leads[c]}
        for a in leads
    }
    assert arrows == {(a, b) for a in leads for b in leads[a] - further[a]}, (
        "arrows that follow from others are left out"
    )
