"""The messages that wait for the recording, and the feedback that waits for the agent: how many are kept, and for how long."""

import json

from hippodrome.trial.core import messages
from hippodrome.trial.core.history import FIELDS_KEPT, FIELDS_WAITING, MESSAGES_KEPT, MessageLog, Word


def test_all_unknown_fields_of_a_trial_are_bounded():
    log, message = MessageLog(), messages.Message(fields={"x": "y" * 900})
    for _ in range(FIELDS_KEPT // 900 + 2):
        log.add(message, 0)
        last = log.messages[-1]
        log.recorded(1, 0)
    assert last == {"ns": 0, "fieldsDropped": 1}


def test_unknown_fields_that_wait_for_a_line_of_the_recording_are_bounded():
    log, message = MessageLog(), messages.Message(fields={"x": "y" * 900})
    for _ in range(FIELDS_WAITING // 900 + 2):
        log.add(message, 0)
    assert len(json.dumps(log.messages)) < FIELDS_WAITING * 1.1
    assert log.messages[-1] == {"ns": 0, "fieldsDropped": 1}
    log.recorded(len(log.messages), 0)
    log.add(message, 0)
    assert "fields" in log.messages[0]


def with_fields(length):
    """Return a message whose unknown fields have this many characters."""
    fields = {"x": "y" * (length - len(str({"x": ""})))}
    assert len(str(fields)) == length
    return messages.Message(fields=fields)


def test_the_fields_of_a_trial_have_room_for_32_mib():
    log = MessageLog()
    for length in (*[2**20] * 31, 2**20 - 100, 100):
        log.add(with_fields(length), 0)
        assert "fields" in log.messages[0]
        log.recorded(1, 0)
    log.add(with_fields(50), 0)
    assert log.messages == [{"ns": 0, "fieldsDropped": 1}]


def test_the_fields_between_two_lines_of_the_recording_have_room_for_1_mib():
    log = MessageLog()
    for length in (2**20 - 100, 100, 50):
        log.add(with_fields(length), 0)
    assert ["fields" in each for each in log.messages] == [True, True, False]


def test_of_a_message_whose_fields_are_too_long_the_rest_is_recorded():
    log = MessageLog()
    log.add(messages.Message(action="up", fields={"x": "y" * 2**20, "z": 1}), 5)
    assert log.messages == [{"ns": 5, "action": "up", "fieldsDropped": 2}]


def test_a_message_without_anything_to_record_is_not_kept():
    log = MessageLog()
    log.add(messages.Message(ack=3), 0)
    assert log.messages == []


# ---- too many messages


def test_five_thousand_messages_of_a_participant_wait_for_a_line_and_more_are_dropped():
    log = MessageLog()
    for _ in range(MESSAGES_KEPT + 2):
        log.add(messages.Message(command="good"), 0)
    log.note("disconnected", 0)
    assert len(log.messages) == len(log.feedback) == MESSAGES_KEPT == 5000
    assert [log.take_dropped(), log.take_dropped()] == [2, 0], "each is counted once"
    log.recorded(1, 0)
    log.note("disconnected", 7)
    assert log.messages[-1] == {"ns": 7, "event": "disconnected"}


def test_each_member_of_a_session_has_room_for_their_own_messages(monkeypatch):
    monkeypatch.setattr("hippodrome.trial.core.history.MESSAGES_KEPT", 3)
    log = MessageLog()
    for player in ("left",) * 5 + ("right",) * 4:
        log.add(messages.Message(command="bad"), 0, player)
    log.note("connected", 0, "third")
    assert [each["player"] for each in log.messages] == ["left"] * 3 + ["right"] * 3 + ["third"]
    assert log.feedback == (Word("bad", "left"),) * 3 + (Word("bad", "right"),) * 3
    assert log.take_dropped() == 3


# ---- what was recorded and heard


def test_what_is_recorded_does_not_wait_any_more_and_the_rest_does():
    log = MessageLog()
    for ns, command in enumerate(("good", "start", "bad", "good")):
        log.add(messages.Message(command=command), ns)
    kept = log.messages
    log.recorded(2, 1)
    assert [each["ns"] for each in log.messages] == [2, 3]
    assert log.feedback == (Word("bad"), Word("good"))
    assert len(kept) == 4, "a copy stays as it was"
    log.heard(1)
    assert (len(log.messages), log.feedback) == (2, (Word("good"),)), "they still wait for the recording"


def test_feedback_that_an_earlier_agent_did_not_hear_comes_before_everything_else():
    log = MessageLog()
    log.add(messages.Message(command="good"), 5, "left")
    log.repeat([Word("bad", "right"), Word("good")], 7)
    assert log.messages == [
        {"ns": 7, "player": "right", "command": "bad", "again": True},
        {"ns": 7, "command": "good", "again": True},
        {"ns": 5, "player": "left", "command": "good"},
    ]
    assert log.feedback == (Word("bad", "right"), Word("good"), Word("good", "left"))
