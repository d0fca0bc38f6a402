"""`make mutants` counts correctly: it reports survivors, and kills mutants that hang."""

from __future__ import annotations

import ast
import sys
from pathlib import Path

import pytest

from tests.mutation.__main__ import ROOT, equivalent
from tests.mutation.modules import TESTED_BY, concerned
from tests.mutation.mutants import Mutants
from tests.mutation.running import Fails, Runner

CORE = '''"""A module that is half tested."""

LIMIT: int = 3


def small(number: int) -> bool:
    """Whether it is small."""
    return number < LIMIT


def twice(number: int) -> int:
    return number * 2
'''
TESTS = """
from core import small

def test_that_four_is_not_small():
    assert small(2) and not small(4)
"""
ENDLESS = """
import itertools

def small(number):
    for step in itertools.count(1):
        if step > 9:
            break
    return number < 4
"""


@pytest.fixture
def project(tmp_path: Path) -> Path:
    (tmp_path / "core.py").write_text(CORE)
    (tmp_path / "test_core.py").write_text(TESTS)
    (tmp_path / "test_nothing.py").write_text("")
    (tmp_path / "pyproject.toml").write_text('[tool.pytest.ini_options]\naddopts = "--import-mode=importlib"\n')
    return tmp_path


def test_each_mutant_is_one_small_change_of_what_runs() -> None:
    mutants = Mutants("core.py", CORE)
    assert [(mutant.line, mutant.was, mutant.becomes) for mutant in map(mutants.__getitem__, range(len(mutants)))] == [
        (3, "LIMIT: int = 3", "LIMIT: int = 4"),
        (8, "return number < LIMIT", "return None"),
        (8, "return number < LIMIT", "return number <= LIMIT"),
        (8, "return number < LIMIT", "return number >= LIMIT"),
        (12, "return number * 2", "return None"),
        (12, "return number * 2", "return number / 2"),
        (12, "return number * 2", "return number * 3"),
    ]


@pytest.mark.parametrize(
    "line",
    ['Size = Literal["small", "large"]', 'self._emit(WriteLog(20, "small"))', 'failure("too small", error, size=2)'],
)
def test_types_and_log_calls_are_not_mutated(line: str) -> None:
    assert len(Mutants("core.py", line)) == 0


def test_the_trial_writes_its_log_by_the_call_that_is_left_out() -> None:
    assert "self._emit(WriteLog(" in (ROOT / "trial/core/session.py").read_text()


def test_a_mutant_that_a_test_notices_is_killed_and_another_survives(project: Path) -> None:
    mutants = Mutants("core.py", CORE)
    judged = Runner(project).judge([mutants[1], mutants[2]], {"core.py": ["test_core.py"]})
    assert {mutant.becomes: killed for mutant, killed in judged} == {
        "return None": True,
        "return number <= LIMIT": False,
    }
    assert (project / "core.py").read_text() == CORE


def test_a_module_without_tests_is_an_error(project: Path) -> None:
    with pytest.raises(Fails, match=r"no test of core\.py"):
        list(Runner(project).judge([Mutants("core.py", CORE)[0]], {"core.py": ["test_nothing.py"]}))


def test_tests_that_fail_without_a_mutation_are_reported(
    project: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They pass when they run for the first time, and not where their libraries are loaded."""
    libraries = tmp_path_factory.mktemp("libraries")
    (libraries / "loaded_once.py").write_text("")
    monkeypatch.syspath_prepend(str(libraries))
    (project / "test_core.py").write_text(
        f"import sys\nassert 'loaded_once' not in sys.modules\nimport loaded_once\n{TESTS}"
    )
    runner, tests = Runner(project), {"core.py": ["test_core.py"]}
    try:
        runner.warm(tests["core.py"])
        with pytest.raises(Fails, match=r"the tests of core\.py cannot judge it"):
            list(runner.judge([Mutants("core.py", CORE)[0]], tests))
    finally:
        sys.modules.pop("loaded_once", None)


def test_libraries_are_loaded_in_the_order_in_which_the_tests_load_them(
    project: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    libraries = tmp_path_factory.mktemp("libraries")
    (libraries / "z_first.py").write_text("")
    (libraries / "a_second.py").write_text("import sys\nassert 'z_first' in sys.modules\n")
    monkeypatch.syspath_prepend(str(libraries))
    (project / "test_core.py").write_text(f"import z_first, a_second\n{TESTS}")
    try:
        Runner(project).warm(["test_core.py"])
        assert "a_second" in sys.modules
    finally:
        for name in ("z_first", "a_second"):
            sys.modules.pop(name, None)


def test_a_mutant_that_never_ends_is_killed(project: Path) -> None:
    mutants = Mutants("core.py", ENDLESS)
    changes = {mutant.becomes: mutant for mutant in map(mutants.__getitem__, range(len(mutants)))}
    tests = {"core.py": ["test_core.py"]}
    quick = Runner(project, seconds=1, idle=120)
    assert [killed for _, killed in quick.judge([changes["continue"]], tests)] == [True]
    assert [killed for _, killed in Runner(project).judge([changes["if step > 10:"]], tests)] == [False]


def test_the_tests_of_every_module_exist() -> None:
    assert [module for module in TESTED_BY if not (ROOT / module).is_file()] == []
    assert [file for module in TESTED_BY for file in concerned(module) if not (ROOT / file).is_file()] == []


def test_each_change_that_changes_nothing_is_listed_for_code_that_is_there() -> None:
    for module, was, _ in equivalent():
        lines = [line.strip() for line in ast.unparse(ast.parse((ROOT / module).read_text())).splitlines()]
        assert lines.count(was) == 1, "a second one may mean something else"
