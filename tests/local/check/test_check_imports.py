"""`make check` compares what agent.py imports with what the image of a participant's server holds."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from hippodrome.control.config import agent_imports, read_project
from hippodrome.protocol.players import ONNXRUNTIME
from tests.local.check.checking import config, run
from tests.local.conftest import ROOT, write_study


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = write_study(tmp_path / "study", start=2)
    config(folder, "  maxRuntime: 5", "  maxRuntime: 5\n  useAWS: true\n  awsSetup: {cpu: 1, memory: 2}")
    return folder


def found(folder: Path) -> list[str]:
    assert read_project(folder).project.use_aws
    return [str(problem) for problem in agent_imports.missing(folder)]


def begin(folder: Path, text: str) -> None:
    file = folder / "agent.py"
    file.write_text(text + "\n" + file.read_text())


def test_a_package_that_the_image_lacks_is_a_mistake_with_its_line_and_what_to_write(folder: Path) -> None:
    begin(folder, "import numpy\nimport psutil")
    wanted = f"psutil=={version('psutil')}"
    assert found(folder) == [
        f"agent.py:2: psutil is not in the servers' image; write {wanted} into requirements.txt beside agent.py"
    ]
    status, lines = run(folder)
    assert status == 1
    assert found(folder)[0] in lines
    assert lines[-1].startswith("1 mistake")
    assert "trying agent.py …" in lines, "what is missing on AWS does not keep the agent from being tried here"


def test_a_missing_package_is_named_as_the_registry_names_it(folder: Path) -> None:
    begin(folder, "def late():\n    from jwt_of_nobody import x\n    import dns.resolver")
    (line,) = found(folder)
    assert line.startswith(
        f"agent.py:3: dns is not in the servers' image; write dnspython=={version('dnspython')} into"
    )


def test_requirements_count_with_their_dependencies(folder: Path) -> None:
    begin(folder, "import minari\nimport psutil\nimport dns.resolver")
    (folder / "requirements.txt").write_text("# mine\nPSUtil >= 5  # comment\n--prefer-binary\nminari==0.5.4\n")
    (line,) = found(folder)
    assert line.startswith("agent.py:3: dns is")


def test_a_package_may_come_with_requirements_that_are_not_installed_here(folder: Path) -> None:
    begin(folder, "import numpy\nimport psutil")
    (folder / "requirements.txt").write_text("no-such-package-anywhere==1\n")
    assert found(folder) == [
        "agent.py:2: remark: whether psutil is in the servers' image is not checked, because no-such-package-anywhere "
        f"is not installed here; to be sure, write psutil=={version('psutil')} into requirements.txt beside agent.py"
    ]
    status, lines = run(folder)
    assert status == 0
    assert found(folder)[0] in lines


@pytest.mark.parametrize(
    ("requirements", "reason"),
    [
        ("no-such-b\nno-such-a==1\n", "because no-such-a and no-such-b are not installed here"),
        ("".join(f"no-such-{x}\n" for x in "abcde"), "because no-such-a, no-such-b, no-such-c and 2 more are not"),
        ("https://example.org/some.whl\n", "because a line of requirements.txt names no package;"),
    ],
)
def test_check_says_why_it_does_not_check_imports(folder: Path, requirements: str, reason: str) -> None:
    begin(folder, "import psutil")
    (folder / "requirements.txt").write_text(requirements)
    (line,) = found(folder)
    assert reason in line


def test_the_packages_of_the_image_are_known_beside_requirements_that_are_not_installed_here(folder: Path) -> None:
    begin(folder, "import numpy, PIL, psutil\nimport dns")
    (folder / "requirements.txt").write_text("no-such-package-anywhere==1\npsutil\ndns\n")
    assert found(folder) == []


def test_parts_of_hippodrome_are_missing_whatever_the_requirements(folder: Path) -> None:
    begin(folder, "import hippodrome.control.model.ids")
    (folder / "requirements.txt").write_text("no-such-package-anywhere==1\n")
    (line,) = found(folder)
    assert line.startswith("agent.py:1: hippodrome.control.model.ids is not in the servers' image")


def test_imports_during_play_are_reported_beside_requirements_that_are_not_installed_here(folder: Path) -> None:
    agent = folder / "agent.py"
    agent.write_text(agent.read_text() + "\n__import__('importlib').import_module('psutil')\n")
    (folder / "requirements.txt").write_text("no-such-package-anywhere==1\n")
    status, lines = run(folder)
    assert [line for line in lines if ": remark: playing loads" in line and "whether psutil is in the" in line]
    assert status == 0


def test_modules_beside_the_agent_are_read_too(folder: Path) -> None:
    begin(folder, "import net\nfrom tools import deep\nimport agent")
    (folder / "net.py").write_text("import net, tools.other\n\nimport psutil\n")
    (folder / "tools").mkdir()
    (folder / "tools" / "__init__.py").write_text("")
    (folder / "tools" / "deep.py").write_text("from . import near\n")
    (folder / "tools" / "near.py").write_text("\nimport dns\n")
    (folder / "tools" / "other.py").write_text("import h5py\n")
    (folder / "unused.py").write_text("import playwright\n")
    assert [line.split(" is ")[0] for line in found(folder)] == [
        "net.py:3: psutil",
        "tools/other.py:1: h5py",
        "tools/near.py:2: dns",
    ]


def test_of_our_own_code_the_image_holds_only_the_trials(folder: Path) -> None:
    begin(
        folder,
        "import hippodrome.trial.agent, hippodrome.protocol, hippodrome.llm\nimport hippodrome.control.model.ids",
    )
    (line,) = found(folder)
    assert (
        line
        == "agent.py:2: hippodrome.control.model.ids is not in the servers' image; it is a part of Hippodrome that servers do not have"
    )


@pytest.mark.parametrize(
    "text",
    [
        "import gymnasium, ale_py, numpy, PIL.Image, yaml, websockets, isal",
        "import cloudpickle, typing_extensions  # what those bring",
        "import os.path, json, __future__, typing",
        "try:\n    import psutil\nexcept ImportError:\n    psutil = None",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import psutil",
        "import typing as t\nif t.TYPE_CHECKING:\n    import psutil",
    ],
)
def test_imports_that_the_image_holds_get_no_finding(folder: Path, text: str) -> None:
    begin(folder, text)
    assert found(folder) == []


def test_packages_for_other_commands_are_not_in_the_image(folder: Path) -> None:
    begin(folder, "import boto3")
    wanted = f"boto3=={version('boto3')}"
    assert found(folder) == [
        f"agent.py:1: boto3 is not in the servers' image; write {wanted} into requirements.txt beside agent.py"
    ]


def test_imports_are_not_checked_without_aws_or_without_a_game(folder: Path) -> None:
    begin(folder, "import psutil")
    config(folder, "useAWS: true", "useAWS: false")
    assert run(folder)[0] == 0


def test_the_image_holds_the_imports_of_the_examples() -> None:
    assert agent_imports.missing(ROOT) == []


@pytest.mark.parametrize("source", [b"(", b"\xff\0", b"import psutil, (", b"#" * 10 + b"\n" + b"(" * 5000])
def test_syntax_errors_are_not_reported_among_the_imports(folder: Path, source: bytes) -> None:
    (folder / "agent.py").write_bytes(source)
    assert found(folder) == []


def test_imports_of_the_game_are_reported_if_the_study_has_aws_setup(folder: Path) -> None:
    config(folder, "  useAWS: true\n", "")
    agent = folder / "agent.py"
    agent.write_text(agent.read_text() + "\n__import__('importlib').import_module('psutil')\n")
    status, lines = run(folder)
    wanted = f"psutil=={version('psutil')}"
    told = f"psutil is not in the servers' image; write {wanted} into requirements.txt beside agent.py"
    assert [line for line in lines if ": remark: playing loads" in line and line.endswith(told)]
    assert status == 0, "it may do without"


def test_a_missing_import_is_a_remark_without_use_aws(folder: Path) -> None:
    begin(folder, "import psutil")
    config(folder, "  useAWS: true\n", "")
    status, lines = run(folder)
    assert [line for line in lines if line.startswith("agent.py:1: remark: psutil is not in the servers' image")]
    assert status == 0


def test_other_imports_during_play_are_not_reported(folder: Path) -> None:
    """The trial's own packages, what the image holds, and what the project imports where it may fail."""
    begin(folder, "import numpy, PIL.Image\ntry:\n    import psutil\nexcept ImportError:\n    psutil = None")
    status, lines = run(folder)
    assert (status, [line for line in lines if "image" in line]) == (0, [])


# --- what config.yml needs


def needed(folder: Path) -> list[str]:
    return [str(problem) for problem in agent_imports.missing_for_players(folder, read_project(folder))]


def policies(folder: Path) -> None:
    (folder / "policies").mkdir()
    for name in ("p", "q"):
        (folder / f"policies/{name}.onnx").touch()


def test_the_package_that_runs_policy_files_must_be_required(folder: Path) -> None:
    policies(folder)
    config(folder, "trial:", "trial:\n  players: {a: human, b: policies/p.onnx, c: sample:policies/q.onnx}")
    (line,) = needed(folder)
    assert line.endswith(
        "trial.players.b: policies/p.onnx needs the package onnxruntime, which is not in the servers' image; "
        f"write {ONNXRUNTIME} into requirements.txt"
    )
    status, lines = run(folder)
    assert (status, line in lines) == (1, True)
    (folder / "requirements.txt").write_text("onnxruntime\n")
    assert needed(folder) == []


def test_the_package_of_a_game_in_a_module_must_be_required(folder: Path) -> None:
    config(folder, "game: ", "game: pettingzoo.classic.rps_v2 # ")
    assert needed(folder) == [], "agent.py makes the game"
    (folder / "agent.py").unlink()
    (line,) = needed(folder)
    assert (
        "trial.game: this game needs the package pettingzoo, which is not in the servers' image; write pettingzoo"
        in line
    )
    (folder / "requirements.txt").write_text("pettingzoo==1.27.0\n")
    assert needed(folder) == []


def test_packages_of_policies_are_not_checked_with_unknown_requirements(folder: Path) -> None:
    policies(folder)
    config(folder, "trial:", "trial:\n  players: {a: human, b: policies/p.onnx}")
    (folder / "requirements.txt").write_text("not_installed_of_nobody\n")
    (line,) = needed(folder)
    assert "remark: " in line
    assert "is not checked, because not-installed-of-nobody is not installed here" in line
