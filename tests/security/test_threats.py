"""docs/security.md: every threat names tests, and every test that it names exists."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

TESTS = Path(__file__).resolve().parents[1]
PAGE = TESTS.parent / "docs" / "security.md"
NAMED = re.compile(r"`([\w/]+\.py)::(\w+)`")
ITEM = re.compile(r"\* \*\*(.+?)\.\*\*(?: (.+))?\[\^([\w-]+)\]")
ACCEPTED = re.compile(r"  \* \*Accepted\*: (.+)")
NOTE = re.compile(r"^\[\^([\w-]+)\]: (.+)$", re.MULTILINE)


def threats() -> Iterator[list[str]]:
    """Each threat, its protection, what is accepted, and the tests; an empty text for what the page does not say."""
    text = PAGE.read_text(encoding="utf-8")
    notes = dict(NOTE.findall(text))
    assert len(notes) == len(NOTE.findall(text)), "each threat has a note of its own"
    lines = text.splitlines()
    for line, after in zip(lines, [*lines[1:], ""], strict=True):
        if re.match(r"\* \*\*.+?\.\*\*", line):
            said = ITEM.fullmatch(line)
            assert said, f"a threat is one line, and ends with its note: {line}"
            accepted = ACCEPTED.fullmatch(after)
            yield [said[1], said[2] or "", accepted[1] if accepted else "", notes.pop(said[3], "")]
    assert not notes, "each note belongs to a threat"


THREATS = list(threats())


@cache
def names_in(file: str) -> frozenset[str]:
    tree = ast.parse((TESTS / file).read_text(encoding="utf-8"))
    return frozenset(
        node.name
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    )


@pytest.mark.parametrize("cells", THREATS, ids=lambda cells: re.sub(r"\W+", "-", cells[0])[:50])
def test_each_threat_has_a_test_that_exists(cells: list[str]) -> None:
    threat, protection, accepted, tests = cells
    assert threat
    assert protection or accepted
    named = NAMED.findall(tests)
    assert named
    assert re.sub(r"[\s,]", "", NAMED.sub("", tests)) == "", "nothing but tests stands there"
    for file, name in named:
        assert (TESTS / file).is_file(), file
        assert name in names_in(file), name


def test_each_list_of_tests_belongs_to_a_threat() -> None:
    assert len(NAMED.findall(PAGE.read_text(encoding="utf-8"))) == sum(
        len(NAMED.findall(cells[3])) for cells in THREATS
    )


def test_the_known_threats_are_listed() -> None:
    text = "\n".join(cells[0] for cells in THREATS).lower()
    assert len(THREATS) >= 40
    for word in (
        "userid", "guessed", "sent again", "another site", "script", "path tricks", "header injection", "log injection", "zip bombs",
        "deep json", "huge bodies", "odd encodings", "slow clients", "hundreds of connections", "floods inputs", "giant websocket", "absurd sizes",
        "poisoned messages", "another installation", "logs", "metrics", "names of resources",
    ):  # fmt: skip
        assert word in text, word


def test_the_page_names_every_test_of_these_files() -> None:
    """A test in these files that no threat names is either unnecessary or missing in the page."""
    named = {name for cells in THREATS for _, name in NAMED.findall(cells[3])}
    for file in ("security/test_requests.py", "security/test_http_fuzz.py", "trial/test_trial_crowds.py"):
        assert names_in(file) <= named, names_in(file) - named
