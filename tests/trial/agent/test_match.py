"""A server without members asks the function `match` of agent.py who plays with whom."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from hippodrome.protocol.keys import groups_key, waiting_key
from hippodrome.trial.agent import match
from hippodrome.trial.agent.match import BadGroups
from hippodrome.trial.recordings.store import FolderStore
from hippodrome.trial.server import matching
from hippodrome.trial.server.matching import Matching
from hippodrome.trial.settings import TrialSettings

QUESTION = {"id": "0" * 20, "players": 2, "waiting": [{"id": name, "answers": {"skill": name}} for name in "abcd"]}


def groups_of(function: Callable[..., Any]) -> tuple[list[list[str]], str]:
    return match.groups(function, QUESTION)


def test_a_group_holds_ids_or_entries_of_waiting_participants() -> None:
    assert groups_of(lambda waiting: [["a", "b"], waiting[2:]]) == ([["a", "b"], ["c", "d"]], "")


def test_match_may_take_the_number_of_players() -> None:
    assert groups_of(lambda waiting, players: [waiting[:players]]) == ([["a", "b"]], "")


def test_match_gets_id_waiting_time_group_and_answers() -> None:
    seen: list[Any] = []
    groups_of(lambda waiting: seen.extend(waiting) or [])
    assert seen[0] == {"id": "a", "waited": 0, "group": None, "answers": {"skill": "a"}}


@pytest.mark.parametrize("returned", [None, "ab", {"a": "b"}, 5, [5], ["ab"], [[1, 2]], [None]])
def test_a_result_that_is_no_list_of_groups_is_refused(returned: Any) -> None:
    with pytest.raises(BadGroups):
        groups_of(lambda waiting: returned)


@pytest.mark.parametrize("bad", [["a"], ["a", "a"], ["a", "x"], ["a", "b", "d"], ["c", "a"]])
def test_a_group_that_cannot_play_is_left_out_and_reported(bad: list[str]) -> None:
    found, problem = groups_of(lambda waiting: [["c", "d"], bad])
    assert found == [["c", "d"]]
    assert problem


DOCS = Path(__file__).resolve().parents[3] / "docs"
SHOWN = [
    textwrap.dedent(block)
    for block in re.findall(
        r"^ {4}def match\((?:.*\n|\n)(?:(?: {4}.*)?\n)+", (DOCS / "sessions.md").read_text(), re.MULTILINE
    )
]
WHO = [("0", "seeker", 0), ("9", "seeker", 0), ("1", "guide", 1), ("9.5", "guide", 1)]
PEOPLE = [
    {"id": name, "waited": 5, "group": group, "answers": {"skill": skill, "role": role}}
    for name, (skill, role, group) in zip("abcd", WHO, strict=True)
]
CHOSEN = {"skill": [["a", "c"], ["b", "d"]], "group": [["a", "c"], ["b", "d"]], "role": [["c", "a"], ["d", "b"]]}


def test_the_docs_show_three_functions() -> None:
    assert len(SHOWN) == len(CHOSEN)


@pytest.mark.parametrize(("code", "chosen"), list(zip(SHOWN, CHOSEN.values(), strict=False)), ids=list(CHOSEN))
def test_the_functions_that_the_docs_show_do_what_they_say(code: str, chosen: list[list[str]]) -> None:
    found: dict[str, Any] = {}
    exec(code, found)
    assert match.groups(found["match"], {"id": "0" * 20, "players": 2, "waiting": PEOPLE}) == (chosen, "")


async def stored_answer(
    tmp_path: Path, function: Callable[..., Any], seconds: float = 20, question: bytes | None = None
) -> Any:
    """Return the answer that a server without members stores; None if it stores none within `seconds`."""
    store = FolderStore(tmp_path)
    store.create(waiting_key("maze"), question if question is not None else json.dumps(QUESTION).encode())

    class Open:
        project_id, session, assigned, agent_dir = "maze", "s." + "0" * 20, False, tmp_path

    server = Matching(store, lambda: cast(TrialSettings, Open), function)
    working = asyncio.create_task(server.run())
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            while not server._answered:
                await asyncio.sleep(0.01)
    working.cancel()
    found = store.get(groups_key("maze", "0" * 20))
    return None if found is None else json.loads(found)


async def test_a_server_stores_what_match_chooses(tmp_path: Path) -> None:
    assert await stored_answer(tmp_path, lambda waiting: [["a", "c"]]) == {"groups": [["a", "c"]]}


async def test_the_answer_of_another_server_is_not_overwritten(tmp_path: Path) -> None:
    FolderStore(tmp_path).create(groups_key("maze", "0" * 20), b'{"groups": [["b", "d"]]}')
    assert await stored_answer(tmp_path, lambda waiting: [["a", "c"]]) == {"groups": [["b", "d"]]}


async def test_a_match_that_raises_matches_no_participants_and_is_reported(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert await stored_answer(tmp_path, lambda waiting: waiting[0]["answers"]["age"]) == {"groups": []}
    assert "KeyError" in caplog.text
    assert "waiting[0]" in caplog.text


async def test_an_error_of_match_tells_the_log_no_answer(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    about = {"age": "forty-one", "income": 31415, "told": "a line\r\nanother"}
    waiting = [{"id": name, "answers": about} for name in ("label-one", "label-two")]
    question = json.dumps(QUESTION | {"waiting": waiting}).encode()

    def failing(waiting: list[dict[str, Any]]) -> list[Any]:
        raise ValueError(f"no number: {waiting}")

    assert await stored_answer(tmp_path, failing, question=question) == {"groups": []}
    assert "in failing" in caplog.text
    assert "ValueError" in caplog.text
    assert not any(word in caplog.text for word in ("forty-one", "31415", "another", "label-one"))


async def test_a_match_that_hangs_is_given_up_and_its_line_is_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match, "SECONDS", 1.0)
    file = tmp_path / "agent.py"
    file.write_text("import time\ndef match(waiting):\n    time.sleep(20)\n")
    found: dict[str, Any] = {}
    exec(compile(file.read_text(), file, "exec"), found)
    assert await stored_answer(tmp_path, found["match"]) == {"groups": []}
    assert "match() has not returned within 1 s, and is in agent.py:3; this server calls it no more" in caplog.text


@pytest.mark.parametrize(
    "body",
    [b"", b"[" * 100_000, b"[]", b'{"id": "../../x", "players": 2, "waiting": []}', b'{"id": "00000000000000000000"}'],
)
async def test_a_wrong_question_is_not_answered(tmp_path: Path, body: bytes) -> None:
    assert matching.read(body) is None
    assert await stored_answer(tmp_path, lambda waiting: [], 0.3, question=body) is None
