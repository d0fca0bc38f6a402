"""A participant's membership: in a session, or unmatched; there is no third kind."""

from __future__ import annotations

import pytest

from hippodrome.control.model.records import to_json
from hippodrome.control.model.sessions import Membership, read_membership

SESSION = "s." + "0" * 20


@pytest.mark.parametrize("membership", [
    Membership(SESSION, 1, members=2, waited=2.5),
    Membership(unmatched=True, completion_code="ABC", waited=300.0),
])  # fmt: skip
def test_a_membership_is_read_as_it_was_written(membership: Membership) -> None:
    assert read_membership(to_json(membership)) == membership


def test_a_document_of_an_earlier_version_has_neither_a_code_nor_a_time() -> None:
    found = read_membership(b'{"unmatched": true}')
    assert (found.session, found.seat, found.members, found.completion_code, found.waited) == (None, 0, 0, "", None)
    assert read_membership(b'{"session": "%b", "seat": 1}' % SESSION.encode()) == Membership(SESSION, 1)


@pytest.mark.parametrize("body", [
    b"{}", b'{"session": null, "unmatched": false}', b'{"session": "%b", "unmatched": true}' % SESSION.encode(),
    b"", b"[]", b'{"unmatched": 1}',
])  # fmt: skip
def test_a_document_that_says_neither_or_both_is_refused(body: bytes) -> None:
    with pytest.raises(ValueError):
        read_membership(body)
