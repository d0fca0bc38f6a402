"""The rules of the lobby, without any I/O: who is proposed, what falls apart, and when patience is over."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from itertools import count
from typing import Any

import pytest
from msgspec.structs import replace

from hippodrome.control.lobby import decisions, matchmaking, rules, servers_ahead
from hippodrome.control.lobby.decisions import Decisions, Formed, Matched, OpenSession, Proposal, Unmatched
from hippodrome.control.lobby.entries import Entries, Waiting, milliseconds
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from tests.control.lobby.waiting_room import pairs

NOW = datetime(2026, 3, 4, 12, 0, 0, tzinfo=UTC)
OPEN_FOR = timedelta(minutes=30)
PATIENCE = 60.0


def ago(seconds: float) -> datetime:
    return NOW - timedelta(seconds=seconds)


def one(label: str, came: float = 5, seen: float = 0, trait: str = "-") -> Waiting:
    """Return the entry of a participant who came and was seen so many seconds ago."""
    return Waiting(label, milliseconds(NOW) - round(came * 1000), trait, ago(seen))


def lobby(*people: Waiting, yes: Mapping[str, Iterable[str]] | None = None, way: Iterable[str] = ()) -> Entries:
    confirmed = {each: frozenset(labels) for each, labels in (yes or {}).items()}
    return Entries(waiting={each.label: each for each in people}, confirmed=confirmed, under_way=frozenset(way))


def in_turn(labels: str, traits_of: str = "") -> list[Waiting]:
    """Entries of participants who came one after the other in the order of the letters, each with a trait."""
    each_trait = traits_of or "-" * len(labels)
    return [one(label, 30 - n, trait=trait) for n, (label, trait) in enumerate(zip(labels, each_trait, strict=True))]


def decide(
    entries: Entries, document: Decisions | None = None, project: Project | None = None, **more: Any
) -> Decisions:
    numbers = count(1)
    return rules.decide(
        document if document is not None else Decisions(),
        entries,
        project or pairs(),
        more.pop("now", NOW),
        lambda: f"new.{next(numbers)}",
        open_for=OPEN_FOR,
        **more,
    )


def groups(document: Decisions) -> list[str]:
    return ["".join(each.labels) for each in document.proposed]


def proposal(labels: str, made: float = 1, name: str = "p", ahead: OpenSession | None = None) -> Proposal:
    return Proposal(name, tuple(labels), ago(made), ahead)


def formed(labels: str, name: str = "f") -> Formed:
    return Formed(name, tuple(Matched(label, label.upper()) for label in labels), ago(1))


# Who is proposed


def test_the_participant_who_came_first_is_proposed_first_and_named_first() -> None:
    people = [one("a", 10), one("b", 40), one("c", 20), one("d", 30), one("e", 5)]
    assert groups(decide(lobby(*people))) == ["bd", "ca"]


def test_the_label_decides_between_two_participants_who_came_in_the_same_millisecond() -> None:
    assert groups(decide(lobby(one("c"), one("b"), one("a")))) == ["ab"]


def test_a_proposal_has_the_present_time_and_a_new_id() -> None:
    assert decide(lobby(*in_turn("abcd"))).proposed == (
        Proposal("new.1", ("a", "b"), NOW, players=2),
        Proposal("new.2", ("c", "d"), NOW, players=2),
    )


@pytest.mark.parametrize(
    ("players", "found"), [(2, ["ab", "cd"]), (3, ["abc"]), (4, ["abcd"]), (5, ["abcde"]), (6, [])]
)
def test_groups_are_full(players: int, found: list[str]) -> None:
    assert groups(decide(lobby(*in_turn("abcde")), project=pairs(players=players))) == found


def test_a_participant_who_was_seen_less_than_ten_seconds_ago_is_there() -> None:
    assert groups(decide(lobby(one("a", 30, 9.999), one("b")))) == ["ab"]
    assert groups(decide(lobby(one("a", 30, 10), one("b")))) == []


@pytest.mark.parametrize(
    "document",
    [
        Decisions(proposed=(proposal("ax"),)),
        Decisions(formed=(formed("ax"),)),
        Decisions(unmatched=(Unmatched("a", "A", NOW),)),
    ],
)
def test_a_participant_in_the_document_is_not_proposed_again(document: Decisions) -> None:
    entries = lobby(*in_turn("abcx"), yes={"p": "ax"})
    found = groups(decide(entries, document))
    assert [each for each in found if each != "ax"] == ["bc"]


@pytest.mark.parametrize("known", [Decisions(proposed=(proposal("ax"),)), Decisions(formed=(formed("ax"),))])
def test_a_participant_who_was_in_the_document_before_the_listing_is_not_proposed(known: Decisions) -> None:
    """They may have a membership by now, which the older listing cannot show."""
    entries = lobby(*in_turn("abc"))
    assert groups(decide(entries, Decisions(), known=known)) == ["bc"]


def test_a_run_makes_fifty_proposals_at_most() -> None:
    people = [one(f"{n:04}", 30 - n / 100) for n in range(104)]
    assert len(decide(lobby(*people)).proposed) == 50
    late = [one(f"{n:04}", 90 - n / 100) for n in range(104)]
    policies = pairs(after_patience="policies")
    assert len(decide(lobby(*late), project=policies).proposed) == 50
    mixed = pairs(players=2, matching="mixed", after_patience="policies")
    assert len(decide(lobby(*late), project=mixed).proposed) == 50


def test_a_decision_without_a_change_returns_the_same_document() -> None:
    document = Decisions(open=(OpenSession("o", ago(5)),), proposed=(proposal("ab"),), formed=(formed("cd"),))
    assert decide(lobby(one("a"), one("b"), one("e")), document) is document


# Who plays with whom


@pytest.mark.parametrize(
    ("matching", "players", "people", "found"),
    [
        ("arrival", 2, ("abcd", "----"), ["ab", "cd"]),
        ("group", 2, ("abcd", "1221"), ["ad", "bc"]),
        ("group", 2, ("abcde", "12333"), ["cd"]),
        ("group", 3, ("abcde", "12121"), ["ace"]),
        ({"same": "x"}, 2, ("abcd", "1212"), ["ac", "bd"]),
        ({"same": "x"}, 2, ("abcd", "1234"), []),
        ({"different": "x"}, 2, ("abcd", "1122"), ["ac", "bd"]),
        ({"different": "x"}, 2, ("abcd", "1111"), []),
        ({"different": "x"}, 3, ("abcde", "11223"), ["ace"]),
        ("mixed", 2, ("abcd", "1122"), ["ac", "bd"]),
        ("mixed", 2, ("abcd", "1112"), ["ad"]),
        ("mixed", 3, ("abcd", "1112"), ["abd"]),  # two groups: as many of one as it takes
        ("mixed", 3, ("abc", "111"), []),
        ("mixed", 4, ("abcdef", "111122"), ["abef"]),
        ("mixed", 4, ("abcdef", "111112"), []),
        ("match", 2, ("abcd", "----"), []),
    ],
)
def test_matching_decides_who_may_play_with_whom(
    matching: Any, players: int, people: tuple[str, str], found: list[str]
) -> None:
    project = pairs(matching=matching, players=players)  # its first page has two groups
    assert groups(decide(lobby(*in_turn(*people)), project=project)) == found


def test_groups_of_different_traits_are_proposed_in_the_order_in_which_their_first_members_came() -> None:
    project = pairs(matching="group")
    assert groups(decide(lobby(*in_turn("abcdef", "122331")), project=project)) == ["af", "bc", "de"]


def test_mixed_without_groups_takes_one_of_each_trait() -> None:
    project = pairs(matching="mixed", players=3, steps=[Step("3", "game")])
    assert groups(decide(lobby(*in_turn("abcd", "1123")), project=project)) == ["acd"]


def proposed_of_chosen(*labels: str, people: str = "abcd", **changes: Any) -> list[str]:
    project = pairs(matching="match", **changes)
    return groups(decide(lobby(*in_turn(people)), project=project, chosen=[list(each) for each in labels]))


def test_chosen_groups_are_proposed_in_their_order_with_members_by_arrival() -> None:
    assert proposed_of_chosen("db", "ca") == ["bd", "ac"]


@pytest.mark.parametrize("wished", ["a", "abc", "aa", "ax", ""])
def test_a_chosen_group_is_proposed_only_if_it_is_full_and_all_members_wait(wished: str) -> None:
    assert proposed_of_chosen(wished, "cd") == ["cd"]


def test_a_participant_in_two_chosen_groups_is_in_the_first() -> None:
    assert proposed_of_chosen("ab", "bc", "cd") == ["ab", "cd"]


def test_chosen_groups_count_only_with_matching_match() -> None:
    assert groups(decide(lobby(*in_turn("abcd")), chosen=[["a", "d"]])) == ["ab", "cd"]


# Patience


def test_patience_ends_at_the_exact_millisecond() -> None:
    project = pairs(patience=PATIENCE)
    assert not matchmaking.patience_is_over(one("a", 59.999).joined, project, NOW)
    assert matchmaking.patience_is_over(one("a", 60).joined, project, NOW)
    assert matchmaking.patience_is_over(one("a", 0.5).joined, pairs(patience=0.5), NOW)


def test_a_participant_whose_patience_is_over_is_not_proposed() -> None:
    assert groups(decide(lobby(one("a", 59.999), one("b")))) == ["ab"]
    assert groups(decide(lobby(one("a", 60), one("b")))) == []
    assert groups(decide(lobby(one("a", 60), one("b"), one("c", 4)))) == ["bc"]


@pytest.mark.parametrize(("there", "found"), [("a", ["a"]), ("ab", ["ab"]), ("abc", ["abc"]), ("abcd", ["abc"])])
def test_with_policies_a_participant_whose_patience_is_over_plays_with_the_others_who_are_there(
    there: str, found: list[str]
) -> None:
    project = pairs(players=3, after_patience="policies")
    people = [one(label, 60 - n) for n, label in enumerate(there)]
    assert groups(decide(lobby(*people), project=project)) == found


def test_with_policies_there_is_no_short_group_before_a_participants_patience_is_over() -> None:
    project = pairs(players=3, after_patience="policies")
    assert groups(decide(lobby(one("a", 59.999), one("b")), project=project)) == []


def test_with_policies_full_groups_come_first_and_each_participant_is_in_one_group() -> None:
    project = pairs(players=2, after_patience="policies")
    people = [one(label, 65 - n) for n, label in enumerate("abc")]
    assert groups(decide(lobby(*people), project=project)) == ["ab", "c"]


def test_with_policies_a_short_group_follows_the_matching() -> None:
    project = pairs(players=3, matching="group", after_patience="policies")
    people = [one("a", 61, trait="1"), one("b", trait="2"), one("c", 4, trait="1"), one("d", 62, trait="3")]
    assert groups(decide(lobby(*people), project=project)) == ["d", "ac"]
    project = pairs(players=3, matching={"different": "x"}, after_patience="policies")
    people = [one("a", 61, trait="1"), one("b", trait="1"), one("c", 4, trait="2")]
    assert groups(decide(lobby(*people), project=project)) == ["ac"]
    project = pairs(players=3, matching="mixed", after_patience="policies")
    people = [one("a", 61, trait="1"), one("b", trait="1"), one("c", 4, trait="1")]
    assert groups(decide(lobby(*people), project=project)) == ["ab"]


def test_two_participants_whose_patience_is_over_are_in_one_short_group() -> None:
    project = pairs(players=3, after_patience="policies")
    assert groups(decide(lobby(one("b", 61), one("a", 62)), project=project)) == ["ab"]


def test_an_unmatched_participant_is_in_the_document_once() -> None:
    ann = Unmatched("a", "A", NOW)
    given = rules.give_up(Decisions(), ann)
    assert given == Decisions(unmatched=(ann,))
    assert rules.give_up(given, Unmatched("a", "A", ago(-1))) is given


@pytest.mark.parametrize("document", [Decisions(proposed=(proposal("ax"),)), Decisions(formed=(formed("ax"),))])
def test_a_participant_who_is_proposed_or_in_a_formed_session_does_not_become_unmatched(document: Decisions) -> None:
    assert rules.give_up(document, Unmatched("a", "A", NOW)) is document


# Proposals that fall apart


def stays(made: float, *people: Waiting, yes: str = "") -> bool:
    document = Decisions(proposed=(proposal("ab", made),))
    return decide(lobby(*people, yes={"p": yes}), document).proposed == document.proposed


def test_a_proposal_falls_apart_after_ten_seconds() -> None:
    assert stays(9.999, one("a"), one("b"), yes="a")
    assert not stays(10, one("a"), one("b"), yes="a")


def test_a_proposal_falls_apart_when_a_member_has_left_even_if_they_have_confirmed() -> None:
    assert not stays(1, one("a"), yes="ab")


def test_a_proposal_falls_apart_when_an_unconfirmed_member_has_not_asked_for_ten_seconds() -> None:
    assert stays(5, one("a", 30, 9.999), one("b"), yes="b")
    assert not stays(5, one("a", 30, 10), one("b"), yes="b")


def test_a_member_who_has_confirmed_need_not_ask_again() -> None:
    assert stays(9, one("a", 30, 25), one("b"), yes="a")


def test_members_of_a_fallen_proposal_keep_their_turn() -> None:
    document = Decisions(proposed=(proposal("ab", 10),))
    entries = lobby(one("a", 40, 11), one("b", 39), one("c", 8), one("d", 7), yes={"p": "b"})
    # The proposal was made after the listing: it stays.
    assert groups(decide(entries, document, known=Decisions())) == ["ab", "cd"]
    fallen = decide(entries, document)
    assert groups(fallen) == ["cd"]  # a and b are proposed by the next run, which lists again
    assert groups(decide(entries, Decisions())) == ["bc"]


def test_a_proposal_that_is_newer_than_the_listing_stays() -> None:
    document = Decisions(proposed=(proposal("ab", 60, "late"), proposal("cd", 60, "early")))
    known = Decisions(proposed=(proposal("cd", 60, "early"),))
    assert groups(decide(lobby(), document, known=known)) == ["ab"]


def test_the_next_proposal_gets_the_server_of_a_fallen_one_and_an_id_of_its_own() -> None:
    ahead = OpenSession("o", ago(100), "x")
    document = Decisions(open=(OpenSession("later", ago(5)),), proposed=(proposal("ab", 10, "p", ahead),))
    fallen = decide(lobby(one("c", 8), one("d", 7)), document)
    assert fallen.proposed == (Proposal("new.1", ("c", "d"), NOW, ahead, players=2),)
    assert [each.id for each in fallen.open] == ["later"]
    assert fallen.proposed[0].session_id == "o"


def test_proposals_are_removed_by_id() -> None:
    ahead = OpenSession("o", ago(3))
    document = Decisions(
        open=(OpenSession("first", ago(9)), OpenSession("last", ago(1))),
        proposed=(proposal("ab", ahead=ahead), proposal("cd", name="q")),
    )
    assert rules.without_proposals(document, ["elsewhere"]) is document
    left = rules.without_proposals(document, ["p"])
    assert groups(left) == ["cd"]
    assert [each.id for each in left.open] == ["first", "o", "last"]


# Confirmed, and formed


def test_a_group_is_confirmed_when_all_members_have_confirmed_and_none_has_left() -> None:
    ab = proposal("ab")
    document = Decisions(proposed=(ab,))
    a, b = one("a"), one("b")
    assert rules.confirmed(document, lobby(a, b, yes={"p": "ab"})) == [ab]
    assert rules.confirmed(document, lobby(a, b, yes={"p": "abc"})) == [ab]
    assert rules.confirmed(document, lobby(a, b, yes={"p": "a"})) == []
    assert rules.confirmed(document, lobby(a, b)) == []
    assert rules.confirmed(document, lobby(a, yes={"p": "ab"})) == []
    assert rules.confirmed(document, lobby(a, b, yes={"another": "ab"})) == []


def test_a_session_is_formed_only_with_the_members_of_its_proposal() -> None:
    members = (Matched("a", "A", 1), Matched("b", "B"))
    document = Decisions(proposed=(proposal("ab"), proposal("cd", name="q")))
    done = rules.form(document, "p", members, NOW)
    assert [(each.id, set(each.members), each.at, each.ahead) for each in done.formed] == [
        ("p", set(members), NOW, False)
    ]
    assert groups(done) == ["cd"]
    assert rules.form(done, "p", members, NOW) is done
    for others in (members[:1], (*members, Matched("c", "C")), members[::-1]):
        assert rules.form(document, "p", others, NOW) is document


def test_every_run_draws_the_same_seats_by_lot() -> None:
    members = tuple(Matched(label, label.upper()) for label in "abc")
    first = Counter[str]()
    for n in range(600):
        document = Decisions(proposed=(proposal("abc", name=f"p{n}"),))
        [found] = rules.form(document, f"p{n}", members, NOW).formed
        [again] = rules.form(document, f"p{n}", members, ago(-5)).formed
        assert found.members == again.members
        assert set(found.members) == set(members)
        first[found.members[0].label] += 1
    assert min(first[label] for label in "abc") > 150


def test_seats_by_group_are_drawn_by_lot_within_a_group_only() -> None:
    members = (Matched("a", "A", 1), Matched("b", "B"), Matched("c", "C", 0), Matched("d", "D", 0))
    orders = set()
    for n in range(60):
        document = Decisions(proposed=(proposal("abcd", name=f"p{n}"),))
        [found] = rules.form(document, f"p{n}", members, NOW, "group").formed
        orders.add("".join(found.labels))
    assert orders == {"cdab", "dcab"}


def test_with_seats_by_match_members_have_the_seats_in_the_chosen_order() -> None:
    project = pairs(players=3, matching="match", seats="match")
    document = decide(lobby(*in_turn("abcd")), project=project, chosen=[["d", "a", "c"]])
    [found] = document.proposed
    assert found.labels == ("d", "a", "c")
    members = tuple(Matched(label, label.upper()) for label in found.labels)
    assert rules.form(document, found.id, members, NOW, "match").formed[0].labels == ("d", "a", "c")
    [by_lot] = decide(
        lobby(*in_turn("abcd")), project=pairs(players=3, matching="match"), chosen=[["d", "a", "c"]]
    ).proposed
    assert by_lot.labels == ("a", "c", "d")


def test_a_formed_session_has_the_id_of_the_server_that_was_started_ahead() -> None:
    document = Decisions(proposed=(proposal("ab", ahead=OpenSession("o", ago(60))),))
    done = rules.form(document, "p", (Matched("a", "A"), Matched("b", "B")), NOW)
    assert [(each.id, each.ahead) for each in done.formed] == [("o", True)]
    assert rules.form(document, "o", (Matched("a", "A"), Matched("b", "B")), NOW) is document


def test_finished_sessions_and_unmatched_participants_leave_the_document() -> None:
    document = Decisions(
        formed=(formed("ab"), formed("cd", "g")), unmatched=(Unmatched("e", "E", NOW), Unmatched("h", "H", NOW))
    )
    assert rules.without_done(document, ["x"]) is document
    assert rules.without_done(document, ["f"]) == Decisions(formed=(formed("cd", "g"),), unmatched=document.unmatched)
    assert rules.without_done(document, ["e"]) == Decisions(
        formed=document.formed, unmatched=(Unmatched("h", "H", NOW),)
    )
    assert rules.without_done(document, ["f", "g", "e", "h"]) == Decisions()


def test_each_change_increases_the_version() -> None:
    before = Decisions(version=7, formed=(formed("ab"),))
    after = decisions.next_version(before, Decisions(version=7))
    assert after == Decisions(version=8)
    assert decisions.next_version(before, before) is before


# The content of the document


def test_the_document_tells_each_participants_state() -> None:
    ab, cd, e = proposal("ab"), formed("cd"), Unmatched("e", "E", NOW)
    document = Decisions(version=3, open=(OpenSession("o", NOW, "z"),), proposed=(ab,), formed=(cd,), unmatched=(e,))
    assert document.labels() == set("abcde")
    assert [document.proposal_of(label) for label in "abcez"] == [ab, ab, None, None, None]
    assert [document.formed_of(label) for label in "acdez"] == [None, cd, cd, None, None]
    assert [document.unmatched_of(label) for label in "acez"] == [None, None, e, None]
    assert [document.is_decided(label) for label in "acdez"] == [False, True, True, True, False]
    assert document.decided_for("c") == Decisions(formed=(cd,))
    assert document.decided_for("e") == Decisions(unmatched=(e,))
    assert document.decided_for("a") == document.decided_for("z") == Decisions()


def test_sessions_that_may_have_a_server() -> None:
    proposed = (proposal("ab", name="p"), proposal("cd", name="q", ahead=OpenSession("o", NOW)))
    document = Decisions(open=(OpenSession("n", NOW),), proposed=proposed, formed=(formed("ef"),))
    assert document.session_ids() == {"n", "o", "f"}


def test_fields_that_the_document_leaves_out_have_defaults() -> None:
    told = b'{"formed": [{"id": "f", "members": [{"label": "a", "userId": "A"}], "at": "2026-03-04T12:00:00Z"}]}'
    assert from_json(told, Decisions) == Decisions(
        0, (), (), (Formed("f", (Matched("a", "A", None),), NOW, False),), ()
    )


def test_the_key_of_the_document() -> None:
    assert decisions.key("maze") == "_lobbies/maze.json"


# How many could play together


def here(label: str, *people: Waiting, document: Decisions | None = None, **changes: Any) -> int:
    return rules.number_here(document or Decisions(), lobby(*people), pairs(**{"players": 3, **changes}), label, NOW)


def test_the_number_of_participants_who_are_there_counts_those_with_whom_one_could_play() -> None:
    assert here("a") == 1
    assert here("a", one("a")) == 1
    assert here("a", one("a"), one("b")) == 2
    assert here("d", *in_turn("abcd")) == 3
    assert here("a", one("a"), one("b", seen=9.999), one("c", seen=10)) == 2
    assert here("a", one("a"), one("b", 60), one("c", 59.999)) == 2
    assert here("a", one("a"), one("b", 60), after_patience="policies") == 2
    assert here("a", one("a"), one("b"), document=Decisions(proposed=(proposal("bx"),))) == 1
    assert here("a", *in_turn("abc", "112"), matching="group") == 2
    assert here("a", *in_turn("abc", "112"), matching={"different": "x"}) == 2
    assert here("a", *in_turn("abc", "111"), matching="mixed") == 2


def test_the_number_of_participants_who_are_there_includes_all_members_of_a_proposal_or_session() -> None:
    assert here("a", document=Decisions(proposed=(proposal("ab"),))) == 2
    assert here("a", document=Decisions(formed=(formed("ab"),))) == 2


# A document that replaces one that could not be read


def test_a_renewed_document_proposes_no_group_and_lets_no_participant_become_unmatched() -> None:
    renewed = Decisions(renewed=ago(5), formed=(formed("ef"),))
    assert decide(lobby(*in_turn("abcd")), renewed) == renewed
    assert rules.give_up(renewed, Unmatched("a", "A", NOW)) is renewed
    fallen = replace(renewed, proposed=(proposal("ab", made=10),))
    assert decide(lobby(*in_turn("ab")), fallen) == renewed


# Servers ahead


def wanted(document: Decisions | None = None, also: Sequence[str] = (), **changes: Any) -> int:
    entries = lobby(one("a"), one("b", seen=20), way="bcd")
    return servers_ahead.sessions_wanted(document or Decisions(), entries, pairs(**changes), also)


def test_one_server_is_wanted_for_each_group_of_participants_who_are_under_way_or_wait() -> None:
    assert wanted() == 2
    assert wanted(also="d") == 2
    assert wanted(also="e") == 3
    assert wanted(players=3) == 2
    assert wanted(players=4) == 1
    assert wanted(max_servers=1) == 1
    assert wanted(max_servers=2) == 2
    assert wanted(max_servers=3) == 2
    assert wanted(Decisions(formed=(formed("ab"),))) == 1
    assert (
        wanted(Decisions(proposed=(proposal("ab"),), unmatched=(Unmatched("c", "C", NOW), Unmatched("d", "D", NOW))))
        == 0
    )
    assert wanted(live=False) == 0


def opened(number: int, *asked: float) -> list[tuple[str, datetime, str]]:
    document = Decisions(open=tuple(OpenSession(f"o{n}", ago(seconds)) for n, seconds in enumerate(asked)))
    numbers = count(1)
    found = servers_ahead.open_sessions(
        document, number, "a", NOW, lambda: f"new.{next(numbers)}", players=2, open_for=OPEN_FOR
    )
    changes = number > len(asked) or any(seconds >= OPEN_FOR.total_seconds() for seconds in asked)
    assert (found is not document) is changes
    return [(each.id, each.requested, each.by) for each in found.open]


def test_as_many_sessions_are_opened_as_are_still_wanted() -> None:
    assert opened(0) == []
    assert opened(2) == [("new.1", NOW, "a"), ("new.2", NOW, "a")]
    assert opened(2, 9) == [("o0", ago(9), ""), ("new.1", NOW, "a")]
    assert opened(1, 9, 8) == [("o0", ago(9), ""), ("o1", ago(8), "")]


def test_an_open_session_is_used_for_half_an_hour() -> None:
    assert len(opened(1, 1799.999)) == 1
    assert len(opened(1, 1800)) == 2
    fresh = Decisions(open=(OpenSession("old", ago(1800)), OpenSession("new", ago(1799.999))))
    decided = decide(lobby(*in_turn("abcd")), fresh)
    assert [each.session_id for each in decided.proposed] == ["new", "new.2"]
    assert [each.id for each in decided.open] == ["old"]


def test_the_server_that_was_started_first_is_used_first() -> None:
    document = Decisions(
        open=(OpenSession("first", ago(9)), OpenSession("second", ago(8)), OpenSession("third", ago(7)))
    )
    decided = decide(lobby(*in_turn("abcd")), document)
    assert [each.session_id for each in decided.proposed] == ["first", "second"]
    assert [each.id for each in decided.open] == ["third"]


def surplus(number: int, over: Iterable[str] = ()) -> set[str]:
    document = Decisions(
        open=tuple(OpenSession(name, ago(seconds)) for name, seconds in [("x", 1800), ("a", 1799), ("b", 9), ("c", 5)])
    )
    return set(servers_ahead.surplus(document, number, set(over), NOW, players=2, open_for=OPEN_FOR))


def test_open_sessions_beyond_the_wanted_number_are_surplus_beginning_with_the_last() -> None:
    assert surplus(3) == {"x"}
    assert surplus(9) == {"x"}
    assert surplus(2) == {"x", "c"}
    assert surplus(0) == surplus(-1) == {"x", "a", "b", "c"}
    assert surplus(2, over="a") == {"x", "a"}


def test_open_sessions_are_removed_by_id() -> None:
    document = Decisions(open=(OpenSession("a", NOW), OpenSession("b", NOW)), formed=(formed("ab"),))
    assert servers_ahead.without_open(document, ["a", "x"]) == Decisions(
        open=(OpenSession("b", NOW),), formed=document.formed
    )


# Erased


def test_nothing_about_an_erased_participant_stays_in_the_decisions() -> None:
    document = Decisions(
        version=4,
        open=(OpenSession("o", ago(9), "a"), OpenSession("n", ago(1), "b")),
        proposed=(
            proposal("ab", ahead=OpenSession("m", ago(5), "a")),
            proposal("cd", name="q", ahead=OpenSession("k", ago(4), "a")),
        ),
        formed=(formed("aef"), formed("gh", "g")),
        unmatched=(Unmatched("a", "A", NOW), Unmatched("z", "Z", NOW)),
    )
    assert rules.without(document, "a") == Decisions(
        version=4,
        open=(OpenSession("o", ago(9)), OpenSession("m", ago(5)), OpenSession("n", ago(1), "b")),
        proposed=(proposal("cd", name="q", ahead=OpenSession("k", ago(4))),),
        formed=(Formed("f", (Matched("", ""), Matched("e", "E"), Matched("f", "F")), ago(1)), formed("gh", "g")),
        unmatched=(Unmatched("z", "Z", NOW),),
    )


def test_a_session_whose_members_are_all_erased_leaves_the_document() -> None:
    document = Decisions(formed=(formed("ab"),))
    assert rules.without(rules.without(document, "a"), "b") == Decisions()


def test_erasing_an_unknown_participant_changes_nothing() -> None:
    document = Decisions(open=(OpenSession("o", NOW, "b"),), proposed=(proposal("bc"),), formed=(formed("de"),))
    assert to_json(rules.without(document, "a")) == to_json(document)


# Which session gets which server


def pair_of(labels: str, server: str, at: datetime = NOW) -> Formed:
    """Return a session that waits for the server of this id."""
    ahead = OpenSession(server, ago(60))
    return Formed(server, tuple(Matched(label, label.upper()) for label in labels), at, True, ahead)


def servers_given(
    document: Decisions, *ready: str, over: Sequence[str] = (), coming: Sequence[str] = (), now: datetime = NOW
) -> dict[str, tuple[str, bool]]:
    """For each session, by its members: the server that it then has, and whether it keeps this server."""
    after = servers_ahead.with_ready_servers(document, ready, over, now, coming=coming, open_for=timedelta(minutes=30))
    waiting = [each for each in after.formed if each.waits_for]
    assert all(each.waits_for and each.waits_for.id == each.id for each in waiting)
    ids = [each.id for each in (*after.open, *after.formed)]
    assert sorted(ids) == sorted(each.id for each in (*document.open, *document.formed)), (
        "no server is lost, or doubled"
    )
    return {"".join(each.labels): (each.id, each.waits_for is None) for each in after.formed}


FIRST, SECOND, THIRD = pair_of("ab", "s1", ago(9)), pair_of("cd", "s2", ago(8)), pair_of("ef", "s3", ago(7))
THREE = Decisions(formed=(SECOND, FIRST, THIRD))


def test_the_session_that_was_formed_first_gets_the_server_that_is_ready_first() -> None:
    assert servers_given(THREE, "s3") == {"ab": ("s3", True), "cd": ("s2", False), "ef": ("s1", False)}


@pytest.mark.parametrize("ready", ["s2", "s3", "s4"])
def test_a_ready_server_of_any_session_goes_to_the_session_that_was_formed_first(ready: str) -> None:
    four = Decisions(formed=(FIRST, SECOND, THIRD, pair_of("gh", "s4", ago(6))))
    assert servers_given(four, ready)["ab"] == (ready, True)


def test_a_session_whose_own_server_is_ready_keeps_it() -> None:
    assert servers_given(THREE, "s1") == {"ab": ("s1", True), "cd": ("s2", False), "ef": ("s3", False)}
    assert servers_given(THREE, "s1", "s2", "s3") == {"ab": ("s1", True), "cd": ("s2", True), "ef": ("s3", True)}


def test_a_ready_server_of_an_open_session_is_given_first() -> None:
    document = Decisions(open=(OpenSession("o", ago(30)),), formed=THREE.formed)
    assert servers_given(document, "o", "s3") == {"ab": ("o", True), "cd": ("s3", True), "ef": ("s2", False)}


def test_an_open_server_that_has_waited_for_too_long_is_not_given() -> None:
    document = Decisions(open=(OpenSession("o", ago(1800)),), formed=(FIRST,))
    assert servers_given(document, "o") == {"ab": ("s1", False)}


def test_a_session_keeps_a_server_that_has_ended_unless_an_open_one_is_ready() -> None:
    assert servers_given(THREE, over=["s1"]) == {"ab": ("s1", True), "cd": ("s2", False), "ef": ("s3", False)}
    assert servers_given(THREE, "s3", over=["s1"]) == {"ab": ("s1", True), "cd": ("s3", True), "ef": ("s2", False)}
    document = Decisions(open=(OpenSession("o", ago(30)),), formed=(FIRST,))
    assert servers_given(document, "o", over=["s1"]) == {"ab": ("o", True)}


def test_a_session_whose_server_has_ended_waits_for_an_open_one_that_starts() -> None:
    document = Decisions(open=(OpenSession("p", ago(40)), OpenSession("o", ago(30))), formed=(FIRST, SECOND))
    assert servers_given(document, over=["s1"], coming=["o", "s2"]) == {"ab": ("o", False), "cd": ("s2", False)}
    assert servers_given(document, over=["s1", "s2"], coming=["o"]) == {"ab": ("o", False), "cd": ("s2", True)}
    assert servers_given(document, "s2", over=["s1"], coming=["o"]) == {"ab": ("o", False), "cd": ("s2", True)}
    late = Decisions(open=(OpenSession("o", ago(1800)),), formed=(FIRST,))
    assert servers_given(late, over=["s1"], coming=["o"]) == {"ab": ("s1", True)}


def of(players: int, session: Formed) -> Formed:
    """Return the session, for a registration with so many players."""
    assert session.waits_for
    return replace(session, players=players, waits_for=replace(session.waits_for, players=players))


def test_a_server_is_given_to_a_session_of_as_many_players_as_it_was_started_for() -> None:
    document = Decisions(open=(OpenSession("o", ago(30), players=3),), formed=(of(2, FIRST), of(3, SECOND)))
    assert servers_given(document, "o") == {"ab": ("s1", False), "cd": ("o", True)}
    assert servers_given(document, "s2") == {"ab": ("s1", False), "cd": ("s2", True)}
    assert servers_given(document, over=["s1"], coming=["o", "s2"]) == {"ab": ("s1", True), "cd": ("s2", False)}


def test_servers_that_were_started_for_another_number_of_players_are_replaced() -> None:
    document = Decisions(open=(OpenSession("two", ago(30), players=2), OpenSession("three", ago(20), players=3)))
    after = servers_ahead.open_sessions(document, 2, "", NOW, lambda: "new", players=3, open_for=OPEN_FOR)
    assert {each.id: each.players for each in after.open} == {"two": 2, "three": 3, "new": 3}
    assert servers_ahead.surplus(after, 2, (), NOW, players=3, open_for=OPEN_FOR) == {"two"}
    trio = decide(lobby(*in_turn("abc")), document, pairs(players=3)).proposed
    assert [(each.session_id, each.players) for each in trio] == [("three", 3)]


def test_a_session_that_has_waited_for_five_minutes_keeps_its_server() -> None:
    assert servers_given(THREE, now=ago(9 - 299)) == {"ab": ("s1", False), "cd": ("s2", False), "ef": ("s3", False)}
    assert servers_given(THREE, now=ago(9 - 300)) == {"ab": ("s1", True), "cd": ("s2", False), "ef": ("s3", False)}


def test_without_a_ready_server_the_document_is_unchanged() -> None:
    for document in (THREE, Decisions(open=(OpenSession("o", NOW),)), Decisions()):
        for ready in ([], ["o", "x"]):
            after = servers_ahead.with_ready_servers(document, ready, (), NOW, open_for=timedelta(minutes=30))
            assert after is document


def test_a_session_that_waits_no_longer_gets_no_other_server() -> None:
    settled = replace(FIRST, waits_for=None)
    assert servers_given(Decisions(formed=(settled, SECOND)), "s1", "s2") == {"ab": ("s1", True), "cd": ("s2", True)}
    assert servers_given(Decisions(formed=(settled, SECOND)), "s1") == {"ab": ("s1", True), "cd": ("s2", False)}


def test_a_session_that_waits_for_a_server_is_not_decided_yet() -> None:
    settled = replace(FIRST, waits_for=None)
    document = Decisions(formed=(settled, SECOND), unmatched=(Unmatched("z", "Z", NOW),))
    assert [document.is_decided(label) for label in "acz"] == [True, False, True]
    assert document.decided_for("c") == Decisions()
    assert document.for_good() == Decisions(formed=(settled,), unmatched=document.unmatched)
    assert document.without_server() == [SECOND]


def test_the_server_that_started_for_an_erased_participant_no_longer_names_them() -> None:
    waits = replace(FIRST, waits_for=OpenSession("s1", NOW, "a"))
    [left] = rules.without(Decisions(formed=(waits,)), "a").formed
    assert left.waits_for == OpenSession("s1", NOW)
    assert left.labels == ("", "b")
