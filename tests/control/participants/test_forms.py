import json
from urllib.parse import quote_plus, urlencode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.http import Request
from hippodrome.control.model.texts import ENGLISH, IN_ENGLISH, Texts
from hippodrome.control.participants import forms
from hippodrome.control.participants.forms import BadForm

names = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=20).filter(
    lambda n: not n.startswith("hippodrome-")
)
values = st.text(st.characters(exclude_categories=["Cs"]))


def posted(body: bytes, kind: str = forms.FORM) -> Request:
    return Request("POST", "/next", (), {"content-type": kind}, body)


@given(st.dictionaries(names, st.lists(values, min_size=1, max_size=4), max_size=8))
def test_every_input_of_a_form_is_kept(fields: dict[str, list[str]]) -> None:
    form = forms.read(posted(urlencode(fields, doseq=True).encode()))
    assert form.answers == {name: v[0] if len(v) == 1 else v for name, v in fields.items()}


@given(st.dictionaries(names, values | st.integers() | st.booleans() | st.none() | st.lists(values), max_size=8))
def test_a_json_object_is_kept_unchanged(answers: dict[str, object]) -> None:
    assert forms.read(posted(json.dumps(answers).encode(), "application/json")).answers == answers


@given(st.binary(max_size=2000), st.sampled_from([forms.FORM, forms.JSON, "text/plain", ""]))
def test_arbitrary_bytes_are_read_as_answers_or_refused_with_a_sentence(body: bytes, kind: str) -> None:
    try:
        form = forms.read(posted(body, kind))
    except BadForm as bad:
        assert bad.status in (400, 413, 415)
    else:
        json.dumps(form.answers, ensure_ascii=False).encode("utf-8")


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        (b"a=" + b"x" * (256 * 1024), forms.FORM, 413),
        (b"&".join(b"a=1" for _ in range(60_000)), forms.FORM, 400),
        (b"a=\xff\xfe", forms.FORM, 400),
        (b"a=%ff%fe", forms.FORM, 400),
        (b"{", forms.JSON, 400),
        (b"[1]", forms.JSON, 400),
        (b'{"a": NaN}', forms.JSON, 400),
        (b'{"a": "\\ud800"}', forms.JSON, 400),
        (b'{"a":' * 30_000 + b"1" + b"}" * 30_000, forms.JSON, 400),
        (b"a=1", "multipart/form-data", 415),
        (b"a=1", "", 415),
    ],
)
def test_a_form_that_cannot_be_accepted_is_refused_with_its_status(body: bytes, kind: str, status: int) -> None:
    with pytest.raises(BadForm) as bad:
        forms.read(posted(body, kind))
    assert bad.value.status == status


def test_fields_that_the_frame_adds_are_no_answers() -> None:
    form = forms.read(posted(f"age=3&hippodrome-step=2&hippodrome-ticket={quote_plus('t&=')}".encode()))
    assert (form.answers, form.step, form.ticket) == ({"age": "3"}, "2", "t&=")


def test_a_form_in_an_address_is_read_like_one_in_a_body() -> None:
    form = forms.read_query([("a", "1"), ("a", "2"), ("b", ""), ("hippodrome-step", "11"), ("hippodrome-ticket", "t")])
    assert form == forms.PostedForm({"a": ["1", "2"], "b": ""}, "11", "t", None)


def test_a_refusal_has_a_reason_in_the_studys_own_words_or_in_english() -> None:
    texts = Texts({"formTooLong": "Zu lang.", "formUnread": "Unlesbar."})
    for refusal, english, own in (
        (BadForm(413, name="formTooLong"), ENGLISH["formTooLong"], "Zu lang."),
        (BadForm(415, "No form."), "No form.", "No form."),
    ):
        assert (refusal.text, refusal.reason(IN_ENGLISH), refusal.reason(texts)) == (english, english, own)
    for body, own in ((None, "Unlesbar."), (b"a" * 300_000, "Zu lang.")):
        with pytest.raises(BadForm) as bad:
            forms.read(Request("POST", "/next", (), {"content-type": forms.FORM}, body))
        assert bad.value.reason(texts) == own


def test_a_name_that_comes_twice_in_json_keeps_both_values() -> None:
    assert forms.read(posted(b'{"a": 1, "a": 2}', forms.JSON)).answers == {"a": [1, 2]}


def nested(levels: int) -> bytes:
    return b'{"a":' + b"[" * (levels - 1) + b"]" * (levels - 1) + b"}"


@pytest.mark.parametrize(
    ("within", "beyond", "kind", "status"),
    [
        (b"a=" + b"x" * (256 * 1024 - 2), b"a=" + b"x" * (256 * 1024 - 1), forms.FORM, 413),
        (b"&".join(b"a=1" for _ in range(2000)), b"&".join(b"a=1" for _ in range(2001)), forms.FORM, 400),
        (
            json.dumps({str(n): 1 for n in range(2000)}).encode(),
            json.dumps({str(n): 1 for n in range(2001)}).encode(),
            forms.JSON,
            400,
        ),
        (nested(20), nested(21), forms.JSON, 400),
        (nested(20).replace(b"[]", b"{}"), nested(20).replace(b"[]", b'[{"b":[]}]'), forms.JSON, 400),
        (b'{"a": 1e308}', b'{"a": 1e999}', forms.JSON, 400),
    ],
)
def test_a_form_at_the_limit_is_read_and_one_beyond_it_refused(
    within: bytes, beyond: bytes, kind: str, status: int
) -> None:
    assert forms.read(posted(within, kind)).answers
    with pytest.raises(BadForm) as bad:
        forms.read(posted(beyond, kind))
    assert bad.value.status == status
    assert bad.value.text == str(bad.value)


def test_a_body_that_could_not_be_decoded_is_refused() -> None:
    with pytest.raises(BadForm) as bad:
        forms.read(Request("POST", "/next", (), {"content-type": forms.FORM}, None))
    assert bad.value.status == 400


def test_constants_that_are_no_json_are_refused_and_named() -> None:
    for name in ("NaN", "Infinity", "-Infinity"):
        with pytest.raises(BadForm):
            forms.read(posted(f'{{"a": {name}}}'.encode(), forms.JSON))


def test_a_field_of_the_frame_that_comes_twice_counts_if_both_values_are_the_same() -> None:
    form = forms.read(posted(b"hippodrome-action=again&hippodrome-action=again&hippodrome-step=2&hippodrome-step=3"))
    assert (form.action, form.step, form.answers) == ("again", None, {})
    form = forms.read(
        posted(b'{"hippodrome-step": [], "hippodrome-ticket": 7, "hippodrome-action": ["x"]}', forms.JSON)
    )
    assert (form.step, form.ticket, form.action) == (None, None, "x")
