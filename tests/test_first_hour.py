"""docs/first-hour.md promises nothing that no test has seen: who runs its commands, and where its failures come from.

What its commands print is held against the page where they run: `tests/ministack/test_first_hour.py` (the real template and
functions) and `tests/deployment/test_first_hour.py` (real servers, and bots that play on them).
"""

from __future__ import annotations

import ast
import re
from functools import cache

import pytest

from tests import first_hour
from tests.deployment.test_first_hour import WITH_SERVERS
from tests.deployment.test_first_hour_failures import GOES_ON, STOPS
from tests.ministack.test_first_hour import BEFORE, DRAINING, FAILURES, NOTHING_LIVE, OF_DNS, STANDING

MENTIONED = {
    "make run": "tests/local",
    "make logs ARGS=--errors": "tests/deployment/operate/test_logs.py",
    "make destroy ARGS=--data": "tests/ministack/test_installation.py",
    "make register ARGS=--live": "tests/ministack/test_first_hour.py",
    'make deploy … ARGS="--site play"': "tests/deployment/stack/test_stack.py",
}
"""Commands in sentences that the story does not run, and who does."""


def test_every_command_is_run_by_a_test() -> None:
    run = [*BEFORE, *STANDING, *DRAINING, *WITH_SERVERS]
    assert sorted(first_hour.shown()) == sorted(run), "each once"


def test_only_the_newcomers_own_values_have_to_be_typed() -> None:
    """The newcomer of the tests has these in the environment."""
    kinds = re.findall(r"(?m)^```(\w+)\n(.*?)^```", first_hour.text(), re.DOTALL)
    assert {kind for kind, _ in kinds} == {"console", "sh"}
    typed = [line for kind, block in kinds if kind == "sh" for line in block.splitlines()]
    names = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_REGION")
    assert [line.partition("=")[0] for line in typed] == [f"export {name}" for name in names]


def test_commands_in_sentences_are_run_by_tests_too() -> None:
    told = first_hour.inline() - set(MENTIONED)
    targets = {" ".join(command.split()[:2]) for command in first_hour.shown()}
    assert {command for command in told if command not in targets} == set()
    assert set(MENTIONED) - first_hour.inline() == set(), "mentioned no more"
    assert [path for path in MENTIONED.values() if not (first_hour.ROOT / path).exists()] == []


ELSEWHERE = {
    "site: The zone already has a record of type … for …": "deployment/lifecycle/test_preflight.py",
    "AWS has not activated this account yet.": "deployment/operate/test_doctor.py",
    "These credentials may not …": "deployment/operate/test_doctor.py",
    "AWS does not allow the installation to run servers.": "control/servers/test_causes.py",
    "The AWS credentials have expired.": "deployment/operate/test_doctor.py",
    "The profile … is of `aws login`, whose credentials cannot be read here.": "deployment/aws/test_account.py",
    "The installation stands, but has no certificate. …": "deployment/lifecycle/test_deploy.py",
    "… wants no further orders …": "certificate/test_command.py",
    "Nothing is ordered until …": "certificate/test_command.py",
    "… has no wheel for Python … on Linux and would have to be compiled.": "deployment/study/test_image_packages.py",
    "The image would lack something: …": "deployment/study/test_image_runs.py",
    "Interrupted. CloudFormation goes on with the stack …": "deployment/stack/test_stack.py",
    "Interrupted. The same command goes on from here.": "deployment/study/test_register_refused.py",
    "Something of that name is in another region: say …": "deployment/lifecycle/test_destroy_waits.py",
    "This has to wait until …; then the rest is deleted.": "deployment/lifecycle/test_destroy_waits.py",
    "After … AWS still refuses to delete …": "deployment/lifecycle/test_destroy_waits.py",
}
"""Failures that other tests bring about, and where."""


def test_every_failure_is_caused_by_a_test() -> None:
    here = {*STOPS, *GOES_ON, NOTHING_LIVE, *(said for _, said in FAILURES), *(said for *_, said in OF_DNS)}
    assert sorted(first_hour.failures()) == sorted([*here, *ELSEWHERE]), "each once"


@pytest.mark.parametrize("message", ELSEWHERE)
def test_a_failure_that_another_test_causes_is_checked_there(message: str) -> None:
    """Three words of it in a row stand in an expectation of that test."""
    test = (first_hour.ROOT / "tests" / ELSEWHERE[message]).read_text()
    said = [part.split() for part in message.rstrip(".").split(first_hour.GAP)]
    threes = [" ".join(part[n : n + 3]) for part in said for n in range(len(part) - 2)]
    assert any(three in test for three in threes)


HOLE = "\0"


ENOUGH = 10  # letters of a piece; shorter ones prove nothing, unless they are a text of their own


@cache
def words() -> frozenset[str]:
    """The texts without a hole, whole."""
    return frozenset(sentences())


@cache
def sentences() -> list[str]:
    """Every text in the code of the commands but docstrings, with a hole where a value comes in."""
    found = []
    deployment = (first_hour.ROOT / "hippodrome" / "deployment").rglob("*.py")
    for file in [*sorted(deployment), first_hour.ROOT / "hippodrome" / "control" / "servers" / "causes.py"]:
        nodes = [*ast.walk(ast.parse(file.read_text()))]
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        for node in nodes:
            if id(node) in docstrings:
                continue
            if isinstance(node, ast.JoinedStr):
                found.append("".join(str(one.value) if isinstance(one, ast.Constant) else HOLE for one in node.values))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return found


def says(message: str) -> bool:
    """Return whether the program can say these words.

    They stand in one of its texts, in order, or are put together from several.
    """
    parts = [part.strip() for part in message.split(first_hour.GAP)]
    in_order = re.compile(".*".join(map(re.escape, parts)), re.DOTALL)
    return any(in_order.search(text) for text in sentences()) or all(map(_put_together, parts))


def _put_together(part: str) -> bool:
    if not part:
        return True
    for end in range(len(part), 0, -1):
        piece = part[:end]
        if (end >= ENOUGH or not re.search(r"\w", piece)) and any(piece in text for text in sentences()):
            return _put_together(part[end:])
        if piece in words():
            return _put_together(part[end:])
    return False


@pytest.mark.parametrize("message", first_hour.failures())
def test_the_words_of_a_failure_are_the_programs(message: str) -> None:
    check, _, rest = message.partition(": ")
    if check in {"domain", "CAA", "region", "site", "VPCs", "left over"}:
        assert any(f'"{check}"' in text for text in sources()), f"no check is called {check}"
        message = rest
    assert says(message)


@cache
def sources() -> list[str]:
    return [file.read_text() for file in (first_hour.ROOT / "hippodrome" / "deployment").rglob("*.py")]


def test_there_are_failures_and_words_that_the_program_does_not_say() -> None:
    assert len(first_hour.failures()) > 20
    assert not says("The stack … could not be painted …")
    assert not says("No AWS planet is set.")


@pytest.mark.parametrize(
    ("shown", "printed", "line"),
    [
        (["a 12 b", "…", "end"], "a 7 b\nx\ny\nend", ""),
        (["a", "end"], "a\nx\nend", "end"),
        (["one … two"], "one or two", ""),
        (["one"], "one\nmore", "(the end; but there comes: more)"),
        (["✓ fine"], "✗ fine", "✓ fine"),
        (["bucket x-0123456789abc in ca-central-1"], "bucket x-93013189d3e19 in us-east-1", ""),
        (["1 person"], "one person", "1 person"),
    ],
)
def test_the_comparison_finds_output_that_differs_from_the_page(shown: list[str], printed: str, line: str) -> None:
    assert first_hour.differs(shown, printed) == line
