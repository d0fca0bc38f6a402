"""`data` and `erase` read the recordings of a real session: to whom each entry belongs, and what concerns one member alone."""

from __future__ import annotations

import asyncio
import csv
import json
from pathlib import Path
from typing import Any

import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from hippodrome.control.model.records import to_json
from hippodrome.control.model.sessions import Membership
from hippodrome.protocol.keys import membership_key
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.recordings.resume import add_lines
from tests.trial.sessions import SID, form, launch_session, member, put, recordings
from tests.trial.two_players import two_players

FEEDBACK = {"ui": {"up": True, "down": True, "start": True, "stop": True, "good": True, "bad": True}}


CALLBACKS = """

class Agent(Agent):
    on_join = on_leave = on_return = lambda self, session, player: "of " + player
    on_feedback = lambda self, session, player, word: word
"""


@pytest.fixture
def store(launch: Any) -> Path:
    """The data of a session in which anna and bert pressed keys and gave feedback, and bert left and came back."""
    server = launch_session(
        launch,
        agent=two_players() + CALLBACKS,
        trial={**FEEDBACK, "recordObservations": True, "pingSamples": 1, "absent": 20},
    )
    form(server.store)
    for seat, user in enumerate(("anna", "bert")):
        put(server.store, membership_key("study", user), to_json(Membership(SID, seat, members=2)))

    async def play() -> None:
        async with member(server, "anna") as anna:
            async with member(server, "bert") as bert:
                await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= 3) for each in (anna, bert)))
                await anna.say(action="up")
                await bert.say(action="down")
                await anna.say(command="good")
                await bert.say(command="bad")
                await asyncio.gather(*(each.until(lambda each=each: len(each.frames) >= 8) for each in (anna, bert)))
            async with member(server, "bert") as bert:
                async with anna.reading():
                    await bert.until(lambda: len(bert.frames) >= 5)
                await anna.say(command="stop")
                await asyncio.gather(anna.closed(), bert.closed())

    asyncio.run(play())
    assert server.wait() == 0
    found: Path = server.store
    return found


def data(store: Path, out: Path) -> dict[str, list[dict[str, str]]]:
    code = main(["data", "study", "--to", str(out), "--from", str(store), "--format", "csv,parquet,minari"])
    assert code == Exit.DONE
    found = {}
    for name in ("answers", "episodes", "problems"):
        with (out / f"{name}.csv").open(newline="") as file:
            found[name] = list(csv.DictReader(file))
    return found


def entries_of_one_player(store: Path, player: str) -> list[Any]:
    """Return all entries of the session's recordings that belong to one player alone."""
    (lines,) = recordings(store).values()
    found: list[Any] = [m for line in lines for m in line.get("messages") or () if m.get("player") in (player, None)]
    for line in lines:
        found += [line[name][player] for name in ("roundTrip", "outcomes") if player in (line.get(name) or {})]
        if line["kind"] in ("presence", "callback") and line["player"] == player:
            found.append(line)
        if line["kind"] not in ("header", "reset"):
            part = (line.get("players") or {}).get(player, {})
            found += [part[name] for name in ("pressedAt", "human") if part.get(name) is not None]
    return found


def test_a_real_session_becomes_tables_and_datasets(store: Path, tmp_path: Path) -> None:
    found = data(store, tmp_path / "out")
    assert found["problems"] == []
    answers = {row["participant"]: row for row in found["answers"]}
    assert {user: (row["session"], row["3.session"], row["3.player"]) for user, row in answers.items()} == {
        "anna": (SID, SID, "left"),
        "bert": (SID, SID, "right"),
    }
    (anna, bert) = found["episodes"]
    assert [(row["participant"], row["player"], row["session"]) for row in (anna, bert)] == [
        ("anna", "left", SID),
        ("bert", "right", SID),
    ]
    assert anna["frames"] == bert["frames"] != "0"
    assert {path.name for path in (tmp_path / "out/minari").iterdir()} == {"study-3-left-v0", "study-3-right-v0"}
    for name in ("left", "right"):
        about = json.loads((tmp_path / f"out/minari/study-3-{name}-v0/data/metadata.json").read_text())
        assert "not recorded" not in about["description"]


@pytest.mark.parametrize(("user", "mine", "other"), [("anna", "left", "right"), ("bert", "right", "left")])
def test_erasing_a_member_removes_from_a_real_recording_what_is_theirs_alone(
    store: Path, tmp_path: Path, user: str, mine: str, other: str
) -> None:
    (whole,) = recordings(store).values()
    theirs, ours = entries_of_one_player(store, other), entries_of_one_player(store, mine)
    assert {"presence", "callback"} <= {each["kind"] for each in ours if isinstance(each, dict) and "kind" in each}
    assert {"key", "command", "action"} & {name for each in ours if isinstance(each, dict) for name in each}
    receipt = ["--receipt", str(tmp_path / "receipt.json")]
    assert main(["erase", user, "study", "--from", str(store), "--yes", *receipt]) == Exit.DONE
    assert entries_of_one_player(store, mine) == []
    assert entries_of_one_player(store, other) == theirs
    (left,) = recordings(store).values()
    before, after = RecordedTrial(), RecordedTrial()
    add_lines(before, whole)
    add_lines(after, left)
    taken = [[{name: part.action for name, part in step.players.items()} for step in each.steps]
             for each in (before.unfinished, after.unfinished) if each]  # fmt: skip
    assert before.ended == after.ended
    assert taken[:1] == taken[1:]
    assert not (store / "study/users" / user).exists()
    found = data(store, tmp_path / "out")
    assert found["problems"] == []
    assert [row["participant"] for row in found["episodes"] if row["player"] == mine] == [""]
