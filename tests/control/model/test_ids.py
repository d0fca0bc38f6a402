from collections import Counter
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import ids
from hippodrome.protocol.keys import NAME

user_ids = st.from_regex(NAME, fullmatch=True)


@pytest.mark.parametrize("text", ["", "a" * 65, "a b", "../x", "a\0", "ä", "a/b", "a.b", "a\n", None, 7, ["a"]])
def test_malformed_user_ids_are_not_ids(text: object) -> None:
    assert not ids.is_user_id(text)
    assert not ids.is_project_id(text)


@given(user_ids, st.integers(1, 7))
def test_a_participant_of_any_id_stays_in_one_group(user: str, variants: int) -> None:
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


def test_both_timers_of_a_server_are_recognized_as_its() -> None:
    name = ids.server_name(ids.server_label("maze", "ann"), 2)
    timers = [name, ids.delayed_timer(name)]
    assert len(set(timers)) == 2
    assert [ids.timer_server(timer) for timer in timers] == [name, name]


def test_other_names_are_not_taken_for_names_of_servers() -> None:
    for name in ("www", "s" + "a" * 20, "s" + "a" * 20 + "-0", "S" + "A" * 20 + "-1", "mail-1", "s" + "1" * 20 + "-1"):
        assert ids.parse_server_name(name) is None


def test_ids_that_differ_only_in_case_have_different_servers() -> None:
    assert ids.server_label("p", "abc") != ids.server_label("p", "ABC")


def test_a_ticket_is_valid_for_one_participant_one_step_and_one_project() -> None:
    ticket = ids.ticket("secret", "alice", "2")
    assert ids.secrets_equal(ticket, ids.ticket("secret", "alice", "2"))
    for other in (("secret", "bob", "2"), ("secret", "alice", "3"), ("other", "alice", "2")):
        assert not ids.secrets_equal(ticket, ids.ticket(*other))
    assert not ids.secrets_equal("ü\ud800", ticket)


def test_names_and_tickets_are_the_same_in_every_version() -> None:
    """A study that runs keeps its links, its servers and its groups when Hippodrome is updated."""
    noon = datetime(2026, 11, 21, 12, tzinfo=UTC)
    assert ids.server_label("maze", "alice") == "s5go4w6wkgepm2vg3dun5"
    assert ids.warm_id("maze", noon, 3) == "~4c5d44b91838eefb73f7"
    assert [ids.group("maze", user, 5) for user in ("alice", "bob", "carol", "dave")] == [2, 4, 3, 4]
    assert ids.ticket("secret", "alice", "2") == "35800f7f679902c295b5179b37396e9d"
    assert ids.link_signature("secret", "maze", "alice") == "579ee2c4dcaa87583171e12f6692f1d6"
    assert ids.completion_code("secret", "alice") == "54H2PFNYF4"


def test_a_servers_name_ends_in_an_attempt_from_1_to_999() -> None:
    label = ids.server_label("maze", "alice")
    assert [ids.parse_server_name(f"{label}-{attempt}") for attempt in ("1", "999")] == [(label, 1), (label, 999)]
    for name in (f"{label}-0", f"{label}-1000", f"{label}-01", f"{label}-", label, f"{label}x-1", f"{label[:-1]}-1"):
        assert ids.parse_server_name(name) is None


def test_the_id_of_a_warm_server_is_distinguished_from_that_of_a_participant() -> None:
    warm_server = ids.warm_id("maze", datetime(2026, 11, 21, 12, tzinfo=UTC), 1)
    assert ids.is_warm_id(warm_server)
    assert not ids.is_user_id(warm_server)
    for other in ("alice", warm_server[1:], warm_server[:-1], f"{warm_server}0", "~" + "g" * 20, None, 7):
        assert not ids.is_warm_id(other)


@pytest.mark.parametrize("text", ["a", "a" * 64, "A-9"])
def test_ids_of_1_to_64_characters_are_well_formed(text: str) -> None:
    assert ids.is_user_id(text)
    assert ids.is_project_id(text)


@pytest.mark.parametrize("text", ["a_b", "a_", "-_a"])
def test_ids_may_have_underscores(text: str) -> None:
    assert ids.is_user_id(text)
    assert ids.is_project_id(text)


@pytest.mark.parametrize("text", ["_servers", "_builds", "_a", "_"])
def test_no_project_has_the_name_of_a_folder_of_hippodrome(text: str) -> None:
    assert ids.is_user_id(text)
    assert not ids.is_project_id(text)


@pytest.mark.parametrize("text", ["a", "7", "alice", "p_1", "a-b", "a" * 63, "0" * 63, "ab--c"])
def test_host_labels(text: str) -> None:
    assert ids.is_host_label(text)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("a" * 64, id="a label has at most 63 bytes"),
        pytest.param("-a", id="begins with a dash"),
        pytest.param("a-", id="ends with one"),
        pytest.param("_acme-challenge", id="begins with an underscore, as names that are no hosts do"),
        pytest.param("a_", id="ends with one"),
        pytest.param("Alice", id="Route 53 would store it in lower case"),
        pytest.param("xn--zzz", id="no Punycode: browsers refuse the address"),
        pytest.param("", id="nothing"),
        pytest.param("s" + "a" * 20 + "-1", id="another server's own name"),
    ],
)
def test_texts_that_are_no_host_labels(text: str) -> None:
    assert not ids.is_host_label(text)
