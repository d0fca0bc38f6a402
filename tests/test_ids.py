from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome import ids

user_ids = st.from_regex(ids.USER_ID, fullmatch=True)


@pytest.mark.parametrize("text", ["", "a" * 65, "a b", "../x", "a\0", "ä", "a/b", "a.b", "a\n", None, 7, ["a"]])
def test_malformed_user_ids_are_not_ids(text: object) -> None:
    assert not ids.is_user_id(text)
    assert not ids.is_project_id(text)


@given(user_ids, st.integers(1, 7))
def test_a_participant_stays_in_one_group_whatever_the_id_looks_like(user: str, variants: int) -> None:
    assert ids.group("p", user, variants) == ids.group("p", user, variants) < variants


@pytest.mark.parametrize("variants", [2, 3, 5])
@pytest.mark.parametrize("make", ["{:024x}", "{}", "P_{}", "{:05d}-x"])
def test_groups_are_equally_likely_for_any_kind_of_id(variants: int, make: str) -> None:
    people = 6000
    drawn = Counter(ids.group("p", make.format(n), variants) for n in range(people))
    expected = people / variants
    chi2 = sum((drawn[g] - expected) ** 2 / expected for g in range(variants))
    assert chi2 < 25  # far beyond chance (p < 0.0001 at 4 degrees of freedom)


@given(user_ids, st.integers(1, 999))
def test_a_servers_name_is_a_dns_label_that_leads_back_and_shows_no_id(user: str, attempt: int) -> None:
    label = ids.server_label("project", user)
    name = ids.server_name(label, attempt)
    assert ids.parse_server_name(name) == (label, attempt)
    assert len(name) <= 63
    assert name == name.lower()
    assert len(user) < 4 or user.lower() not in name


def test_names_of_others_are_not_taken_for_servers() -> None:
    for name in ("www", "s" + "a" * 20, "s" + "a" * 20 + "-0", "S" + "A" * 20 + "-1", "mail-1", "s" + "1" * 20 + "-1"):
        assert ids.parse_server_name(name) is None


def test_ids_that_differ_only_in_case_have_different_servers() -> None:
    assert ids.server_label("p", "abc") != ids.server_label("p", "ABC")


def test_a_ticket_fits_one_person_one_step_and_one_project() -> None:
    ticket = ids.ticket("secret", "alice", "2")
    assert ids.same(ticket, ids.ticket("secret", "alice", "2"))
    for other in (("secret", "bob", "2"), ("secret", "alice", "3"), ("other", "alice", "2")):
        assert not ids.same(ticket, ids.ticket(*other))
    assert not ids.same("ü\ud800", ticket)
