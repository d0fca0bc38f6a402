"""Messages are parsed into records or refused, whatever they hold."""

import contextlib
import json
import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.trial.core import messages
from testing.exploration import examples

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=10),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
FIELDS = st.dictionaries(
    st.sampled_from(["command", "action", "held", "changeFrameRate", "ack", "x"]), JSON, max_size=4
)


@settings(max_examples=examples(300))
@given(st.one_of(st.text(), st.binary(), JSON.map(json.dumps), FIELDS.map(json.dumps)))
def test_parsing_raises_only_errors_of_messages(data):
    for parse in (messages.parse, messages.parse_hello):
        try:
            parse(data)
        except (messages.NotAMessage, messages.BadMessage) as error:
            messages.error(str(error))


@pytest.mark.parametrize(
    "text", ["[" * 4000, "1" * 4096, '{"ack": ' + "9" * 4000 + "}", '{"changeFrameRate": ' + "9" * 4000 + "}"]
)
def test_very_deep_or_long_json_is_read_or_refused(text):
    with contextlib.suppress(messages.NotAMessage, messages.BadMessage):
        messages.parse(text)


def test_messages_have_the_form_of_docs_wire():
    message = messages.parse('{"command": "start", "action": "LEFT", "held": true, "changeFrameRate": 40, "ack": 3}')
    assert message == messages.Message("start", "left", True, 40.0, 3)
    assert "ack" not in message.record()
    assert messages.parse_hello('{"userId": "a", "token": "t", "step": 3, "projectId": "p"}') == messages.Hello(
        "a", "t", "3", names_project=True, project_id="p"
    )
    assert json.loads(messages.state("break", 2, 340.0, 30, episode_score=40.5, next_in=2.5)) == {
        "state": "break",
        "episode": 2,
        "score": 340,
        "episodeScore": 40.5,
        "nextIn": 2.5,
        "frameRate": 30,
    }
    assert json.loads(messages.done(1, math.nan))["score"] == 0


@pytest.mark.parametrize(
    ("said", "decodes"),
    [
        ("{}", {"deflate"}),
        ('{"decodes": null}', {"deflate"}),
        ('{"decodes": ["jpeg"]}', {"jpeg"}),
        ('{"decodes": ["deflate", "jpeg", "objects", "a later one"]}', {"deflate", "jpeg", "objects"}),
    ],
)
def test_the_first_message_says_what_a_client_decodes(said, decodes):
    assert messages.parse_hello(said).decodes == decodes


@pytest.mark.parametrize("said", ["[]", '["objects"]', '"jpeg"', "[1]", "[[]]", "7", "true", "{}"])
def test_a_client_that_could_be_shown_no_picture_is_refused(said):
    with pytest.raises(messages.BadMessage, match="decodes must"):
        messages.parse_hello(f'{{"decodes": {said}}}')
