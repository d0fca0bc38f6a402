"""Who says what to whom, event by event."""

from __future__ import annotations

from hippodrome.trial.core.effects import AskReply, Moderate, RecordTalk, SendTalk
from hippodrome.trial.core.players import alone
from hippodrome.trial.core.talk import AGENT_RATE, tidied
from tests.trial.core.trial_driver import Driver
from tests.trial.session_driver import SessionDriver


def told(driver, number, key="lines"):
    """What a member was sent of talk."""
    return [
        e.fields for e in driver.all if isinstance(e, SendTalk) and e.connection == f"tab{number}" and key in e.fields
    ]


def read(driver, number):
    lines = {line["n"]: line for fields in told(driver, number) for line in fields["lines"]}
    return [(line["by"], line["text"]) for line in lines.values()]


def refused(driver, number):
    return [fields["refused"]["why"] for fields in told(driver, number, "refused")]


def taped(driver):
    return [effect.fields for effect in driver.all if isinstance(effect, RecordTalk)]


def talks(driver, **can):
    for name, able in can.items():
        setattr(driver.trial.talk, name, able)
    return driver


def say(driver, number, n, text):
    return driver.say(number, say={"id": n, "text": text})


def test_buyers_who_all_talk_to_the_seller_do_not_read_each_other():
    driver = SessionDriver(3, chat={"with": ["left"]}).come(0, 1, 2)
    say(driver, 1, 1, "How much?")
    say(driver, 0, 1, "100")
    assert read(driver, 0) == [("right", "How much?"), ("left", "100")]
    assert read(driver, 1) == [("right", "How much?"), ("left", "100")]
    assert read(driver, 2) == [("left", "100")]
    assert [(line["by"], line.get("to")) for line in taped(driver)] == [("right", ["left"]), ("left", None)]


def test_each_participant_talks_with_the_agent_alone():
    driver = talks(SessionDriver(chat={"with": ["ai"]}).come(0, 1), replies=True)
    say(driver, 0, 1, "Psst")
    (ask,) = driver.calls(AskReply)
    assert (ask.player, ask.text, ask.n) == ("left", "Psst", 1)
    assert told(driver, 0, "typing") == [{"typing": {"ai": True}}]
    driver.event("reply_grows", ask.ask_id, "Ye", driver.now)
    driver.event("reply_ended", ask.ask_id, "Yes", driver.now)
    assert read(driver, 0) == [("left", "Psst"), ("ai", "Yes")]
    assert read(driver, 1) == []
    assert taped(driver)[-1]["answers"] == 1


def test_a_line_is_said_once_however_often_it_is_sent_and_its_echo_comes_again():
    driver = SessionDriver(chat={}).come(0, 1)
    for text in ("Hi", "Hi", "something else"):
        say(driver, 0, 7, text)
    assert read(driver, 1) == [("left", "Hi")]
    assert [fields["lines"][0]["id"] for fields in told(driver, 0) if fields["lines"]] == [7, 7, 7]
    assert len(taped(driver)) == 1
    driver.come(1)
    assert told(driver, 1)[-1]["lines"] == [{"n": 1, "by": "left", "text": "Hi"}]


def test_lines_are_refused_with_the_reason():
    driver = SessionDriver(chat={"maxLength": 5, "phrases": ["Wait!"], "typing": False}).come(0)
    for n, text in enumerate(["", " \x00 ", "123456", "Hello"], 1):
        say(driver, 0, n, text)
    assert refused(driver, 0) == ["empty", "empty", "tooLong", "notAPhrase"]
    for n in range(10, 17):
        say(driver, 0, n, "Wait!")
    assert refused(driver, 0)[4:] == ["tooFast", "tooFast"]
    driver.wait(5)
    say(driver, 0, 15, "Wait!")
    assert len(read(driver, 0)) == 6, "a line that was too fast may come again"


def test_no_participant_keeps_the_agent_from_the_others():
    driver = talks(SessionDriver(chat={"with": ["ai"]}).come(0, 1), replies=True)
    for n in range(1, 8):
        say(driver, 0, n, "Hi")
        driver.wait(2)
    assert refused(driver, 0) == ["tooFast", "tooFast"]
    say(driver, 1, 1, "And me?")
    first, *_, last = driver.calls(AskReply)
    assert (len(driver.calls(AskReply)), last.player) == (6, "right")
    driver.event("reply_ended", first.ask_id, None, driver.now)
    say(driver, 0, 6, "Hi")
    assert len(driver.calls(AskReply)) == 7


def test_lines_that_wait_for_moderate_are_as_few():
    driver = talks(SessionDriver(chat={}).come(0, 1), moderates=True)
    for n in range(1, 8):
        say(driver, 0, n, "Hi")
        driver.wait(2)
    assert refused(driver, 0) == ["tooFast", "tooFast"]


def test_control_characters_and_too_many_newlines_are_taken_out():
    assert tidied("\ta\x00b\x1b[31m\r\nc\u2028d\x85 ") == "ab[31m\nc\nd"
    assert tidied("\n".join("x" * 20)).count("\n") == 10
    assert tidied("\ud800Hi") == "Hi"
    assert tidied("\u200f\u05e9 <b>") == "\u200f\u05e9 <b>"


def test_one_line_each_and_who_is_away_for_good_is_passed_over():
    section = {"afterAbsent": "policy", "substitute": "random", "absent": 5}
    driver = talks(SessionDriver(3, chat={"turns": "alternate", "first": "right"}, **section).begin(), replies=False)
    say(driver, 0, 1, "I?")
    say(driver, 1, 1, "one")
    say(driver, 1, 2, "two")
    assert refused(driver, 0) == refused(driver, 1) == ["notYourTurn"]
    assert told(driver, 0)[-1]["turn"] == "third"
    driver.go(2).wait(6)
    assert told(driver, 0)[-1]["turn"] == "left"


def test_the_agent_speaks_in_its_turn_and_passes_it_on_if_it_says_nothing():
    driver = Driver(chat={"turns": "alternate"}).begin()
    driver.trial.talk.replies = True
    driver.reset()
    driver.connect()
    for n, answer in ((1, "Hello"), (2, None)):
        driver.say(say={"id": n, "text": "Hi"})
        (ask,) = driver.of(AskReply)
        driver.say(say={"id": 9, "text": "Me again"})
        assert driver.of(SendTalk)[0].fields["refused"]["why"] == "notYourTurn"
        driver.event("reply_ended", ask.ask_id, answer, driver.now)
        assert [e.fields["turn"] for e in driver.of(SendTalk) if "turn" in e.fields] == ["player_0"]


def test_moderate_holds_back_or_changes_a_line_and_what_was_typed_is_on_the_tape():
    driver = talks(SessionDriver(chat={}).come(0, 1), moderates=True)
    say(driver, 0, 1, "rude")
    say(driver, 0, 1, "rude")
    (first,) = driver.calls(Moderate)
    assert read(driver, 1) == []
    driver.event("moderated", first.ask_id, False, driver.now)
    say(driver, 0, 1, "rude")
    assert refused(driver, 0) == ["held", "held"]
    say(driver, 0, 2, "Bad word")
    driver.event("moderated", driver.calls(Moderate)[-1].ask_id, "*** word", driver.now)
    assert read(driver, 1) == [("left", "*** word")]
    assert [(line["text"], line.get("held"), line.get("original")) for line in taped(driver)] == [
        ("rude", True, None),
        ("*** word", None, "Bad word"),
    ]


def test_an_agent_that_says_a_thousand_lines_a_second_is_cut_off():
    driver = SessionDriver(chat={}).come(0)
    for n in range(1000):
        driver.event("agent_says", f"line {n}", None, None, driver.now + n / 1000)
    assert AGENT_RATE <= len(read(driver, 0)) <= 2 * AGENT_RATE


def test_a_line_to_a_game_in_which_nobody_talks_is_refused():
    driver = SessionDriver().come(0)
    say(driver, 0, 1, "Hello?")
    driver.say(0, typing=True)
    assert driver.errors(0) == ["nobody talks in this game"] * 2


def test_what_earlier_servers_have_recorded_is_there_again_and_a_line_without_an_answer_is_asked_again():
    where = {"episode": 1, "step": 3}
    said = [
        {"kind": "line", "n": 1, "by": "player_0", "text": "Hi", "id": 5, **where},
        {"kind": "line", "n": 2, "by": "ai", "text": "Hello", "answers": 1, **where},
        {"kind": "line", "by": "player_0", "text": "rude", "id": 6, "held": True, **where},
        {"kind": "line", "n": 3, "by": "player_0", "text": "And?", "id": 7, **where},
        {"kind": "cut", "n": 4, "by": "ai", "text": "Wel", "answers": 3, **where},
    ]
    driver = Driver(chat={})
    driver.all += driver.trial.start(alone(("noop",)), None, driver.now, said=said)
    driver.all += driver.trial.recording_opened(driver.now)
    driver.trial.talk.replies = True
    driver.reset()
    driver.connect()
    (ask,) = driver.of(AskReply)
    assert (ask.text, ask.n) == ("And?", 3)
    driver.say(say={"id": 7, "text": "And?"})
    assert driver.of(SendTalk)[0].fields["lines"] == [{"n": 3, "by": "player_0", "text": "And?", "id": 7}]
    driver.say(say={"id": 6, "text": "rude"})
    assert driver.of(SendTalk)[0].fields["refused"]["why"] == "held"
    assert [(step, each.text) for step, each in driver.trial.talk.repeats(1)] == [(3, "Hi")]
    assert [line.text for line in driver.trial.talk.lines_of("player_0", 1)] == ["Hi"]
