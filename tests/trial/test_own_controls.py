"""The project's own controls in `ui`: each is a button on the page, and a word for the agent."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hippodrome.protocol import trial, trial_check
from hippodrome.trial.core import messages
from hippodrome.trial.core.history import MessageLog, RecordedTrial, Word
from hippodrome.trial.core.messages import BadMessage
from hippodrome.trial.recordings.resume import add_lines
from hippodrome.trial.settings import trial_section
from hippodrome.trial.wire import plain

UI = {"start": True, "left": True, "reallyGood": True, "fire": True, "leftUp": True, "brightness": False}


def config(ui: dict[str, Any], **more: Any) -> trial.TrialSection:
    return trial_section({"game": "g", "ui": ui, **more})


def problems(ui: dict[str, Any]) -> list[str]:
    return [f"{'.'.join(map(str, path))}: {said}" for path, said, _ in trial_check.check({"ui": ui})[1]]


# ---- what the section may say


def test_other_keys_of_ui_are_words_for_the_agent() -> None:
    found = config({**UI, "wait": "yes"})
    assert messages.words_of(found) == ("reallyGood", "wait")
    assert set(found.ui.shown()) == {"start", "left", "reallyGood", "fire", "leftUp", "wait"}


def test_a_control_with_the_name_of_an_action_is_no_word() -> None:
    assert messages.words_of(config({"jump": True, "wait": True}, actionSpace=["noop", "Jump"])) == ("wait",)


def test_the_section_with_its_defaults_is_accepted_again() -> None:
    found, wrong = trial_check.check({"ui": UI})
    assert wrong == []
    assert found.document()["ui"]["reallyGood"] is True
    assert "brightness" not in found.document()["ui"]
    assert trial_check.check(found.document()) == (found, [])


@pytest.mark.parametrize(
    ("ui", "said"),
    [
        ({"wait": "perhaps"}, 'ui.wait: must be true or false, not "perhaps"'),
        ({"toggle": True}, "ui.toggle: the game's server knows this word already; give the control another name"),
        ({"requestUI": True}, "ui.requestUI: the game's server knows this word already; give the control another name"),
        ({"x" * 65: True}, f"ui.{'x' * 65}: must be at most 64 characters long, not 65"),
        (
            {"a\nb": True},
            "ui.a\nb: must be the name of a control; take out its tabs, line ends and invisible characters",
        ),
        ({f"word{number}": True for number in range(33)}, "ui: must have at most 32 controls of your own, not 33"),
    ],
)
def test_wrong_controls_are_refused(ui: dict[str, Any], said: str) -> None:
    assert problems(ui) == [said]


def test_an_empty_control_or_one_that_is_off_does_not_exist() -> None:
    assert messages.words_of(config({"wait": None, "toggle": False, "more": ""})) == ()


# ---- messages


def test_only_the_words_of_this_project_are_commands() -> None:
    assert messages.parse('{"command": "wait"}', ("wait",)).command == "wait"
    for said in ("other", "Wait", 3, None):
        with pytest.raises(BadMessage, match="unknown command"):
            messages.parse(json.dumps({"command": said}), ("wait",))


def test_hippos_client_sends_words_too() -> None:
    assert plain.parse('{"command": "reallyGood", "frameId": 3}', ("reallyGood",)).command == "reallyGood"
    assert plain.parse('{"command": "ReallyGood"}', ("reallyGood",)).command == "reallyGood"
    assert plain.parse('{"command": "other"}', ("reallyGood",)).fields == {"command": "other"}


def test_words_are_heard_and_repeated_like_other_feedback() -> None:
    log = MessageLog()
    for command in ("wait", "start", "good"):
        log.add(messages.parse(json.dumps({"command": command}), ("wait",)), 1)
    assert log.feedback == (Word("wait"), Word("good"))
    recorded = RecordedTrial()
    step = {"kind": "step", "episode": 1, "human": 0, "action": 0, "reward": 1.0, "messages": log.messages}
    add_lines(recorded, [{"kind": "reset", "episode": 1, "seed": 3}, step])
    assert recorded.unfinished is not None
    assert recorded.unfinished.steps[0].feedback == (Word("wait"), Word("good"))


# ---- a real server


async def test_a_press_reaches_the_agent_and_is_recorded(launch: Any, open_client: Any, grid: Any) -> None:
    agent = grid().replace('"nan": float("nan")', '"heard": getattr(self, "word", None)')
    server = launch(agent, {"ui": UI, "startingFrameRate": 60, "actionSpace": ["noop", "up", "left"]})
    async with open_client(server.address) as client:
        await client.enter()
        await client.say(command="start")
        await client.say(command="reallyGood")
        await client.say(command="leftUp")
        await client.until(lambda: client.errors)
        seen = len(client.frames)
        await client.until(lambda: len(client.frames) > seen + 5)
    assert client.controls["words"] == ["reallyGood"]
    assert client.controls["UI"] == ["left", "start", "reallyGood", "fire", "leftUp"]
    assert client.errors == ["unknown command 'leftUp'"]
    server.terminate()
    server.wait()
    (lines,) = server.recordings().values()
    steps = [line for line in lines if line["kind"] == "step"]
    said = [any(m.get("command") == "reallyGood" for m in line.get("messages", ())) for line in steps]
    assert said.count(True) == 1
    heard = [line["info"]["heard"] for line in steps]
    assert heard == [None] * said.index(True) + ["reallyGood"] * (len(steps) - said.index(True))
