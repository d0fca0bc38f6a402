"""Participants who play together on a simulated AWS: no group is split or merged, and none has a member who does not ask any more.

After any fault at any time, each participant comes to the end or sees why not, and nothing is left.
"""

from __future__ import annotations

import json
import math
import re
from datetime import datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from hippodrome.control.lobby import decisions
from hippodrome.control.model.project import MASTER_LIST
from hippodrome.protocol.keys import answer_key, membership_key, session_key
from hippodrome.protocol.session import Member as Seated
from hippodrome.protocol.session import SessionDocument
from testing.simulation import faults, lobby, session_checks
from testing.simulation.conditions import Conditions
from testing.simulation.members import POLL, PROPOSED_POLL, Habits, SimulatedMember
from testing.simulation.trials import SimTrial
from testing.simulation.world import PROJECT, WIRES, SimulatedWorld
from tests.simulation.explored import assert_faults_do_harm_without_repair, assert_no_fault_does_harm

SEED = 7
PAIRS = msgspec.structs.replace(PROJECT, players=2, patience=300.0)


# Journeys


@pytest.mark.parametrize("journey", faults.JOURNEYS_OF_GROUPS, ids=lambda journey: journey.name)
def test_a_groups_journey_without_faults_ends_as_expected(journey):
    _, outcome = faults.run(journey, SEED)
    assert outcome.well, outcome
    finished = sum(visit.finished is not None for visit in (outcome.visit, *outcome.others))
    assert journey.to_the_end in (None, finished), outcome


@pytest.mark.explores
@pytest.mark.timeout(600)
@pytest.mark.parametrize("journey", faults.JOURNEYS_OF_GROUPS, ids=lambda journey: journey.name)
def test_a_fault_at_any_call_splits_or_merges_no_group_strands_no_participant_and_leaves_nothing(journey):
    assert_no_fault_does_harm(journey, SEED)


def test_without_the_sweep_and_with_one_delivery_faults_strand_a_participant_or_leave_something(monkeypatch):
    assert_faults_do_harm_without_repair(faults.JOURNEYS_OF_GROUPS[0], SEED, monkeypatch)


# Crowds


def crowd(people, seconds, conditions=None, *, project=PAIRS, habits=lambda number: Habits(), seed=SEED, **account):
    world = SimulatedWorld(seed, conditions, project, **account)
    came = [SimulatedMember(world, number, habits=habits(number)) for number in range(people)]
    for person in came:
        world.clock.spawn(person.walk, delay=world.clock.random.uniform(0, seconds))
    world.settle(2 * 3600)
    return world, came


def assert_fair(world, came):
    """Check that nothing is left or wrong, and that each participant came to the end, left, or saw why not."""
    assert session_checks.faults(world.platform.documents.kept, world.project, came) == [], world.story()
    assert not any(world.left().values()), (world.left(), world.story())
    assert all(faults.served_or_told(person.visit) for person in came), [p.visit.reason for p in came]
    assert not world.cloud.dropped, "no chain of messages is taken for a loop"


def in_groups(world, came):
    """Return the numbers of participants who came to the end as members of a full session, and as unmatched ones."""
    full = [one for one in lobby.formed(world.platform.documents.kept, world.project) if len(one.members) > 1]
    together = {member.user_id for one in full for member in one.members}
    finished = [person.visit.user for person in came if person.visit.finished is not None]
    return sum(user in together for user in finished), sum(user not in together for user in finished)


def test_sixty_participants_who_come_within_ten_seconds_are_all_matched():
    world, came = crowd(60, 10)
    assert_fair(world, came)
    assert in_groups(world, came) == (60, 0)
    assert world.cloud.conflicts[decisions.key(PAIRS.id)] > 10, "runs of the lobby overlap"


@pytest.mark.timeout(600)
def test_a_hundred_pairs_are_matched_by_a_function_on_servers_that_were_started_ahead():
    world, came = crowd(200, 15, project=msgspec.structs.replace(PAIRS, matching="match"))
    assert_fair(world, came)
    assert in_groups(world, came) == (200, 0)
    matching = world.matching
    assert matching.answered > 5
    assert matching.most_waiting > 10, "many stand in one question"
    waited = [one.matched - one.lobby for one in came]
    assert max(waited) < 40, "each question is answered within seconds, and none of those who wait is forgotten"
    assert not [key for key in world.platform.documents.kept if key.startswith("_match/")]


def test_participants_who_find_no_group_of_four_are_unmatched():
    world, came = crowd(30, 10, project=msgspec.structs.replace(PAIRS, players=4, patience=60.0))
    assert_fair(world, came)
    assert in_groups(world, came) == (28, 2)


def test_servers_of_sessions_that_spot_takes_are_replaced_for_all_members():
    world, came = crowd(60, 20, Conditions(interrupted=0.4, interrupted_after=(5.0, 150.0)))
    assert_fair(world, came)
    assert in_groups(world, came) == (60, 0)
    assert sum(task.interrupted for task in world.platform.tasks.tasks.values()) >= 5
    assert sum(person.visit.interruptions for person in came) >= 4
    played = [seconds for seconds in world.trials.played.values() if seconds]
    assert len(played) == 30
    assert all(math.isclose(seconds, 60.0, abs_tol=1.0) for seconds in played), "no game begins anew, none is shorter"


def test_slow_services_and_repeated_and_late_events_split_no_group():
    conditions = Conditions(slow_zone=1.0, s3=(0.1, 0.2), late=0.5, repeated=0.5, late_addresses=0.5)
    world, came = crowd(40, 20, conditions)
    assert_fair(world, came)
    assert in_groups(world, came) == (40, 0)


def test_lost_events_split_no_group():
    world, came = crowd(40, 20, Conditions(lost=0.15))
    assert_fair(world, came)
    assert in_groups(world, came) == (40, 0)


def test_participants_who_leave_the_lobby_are_matched_only_if_they_asked_a_moment_before():
    """One in five closes the page, half of these without a leave message; another one in five reloads or loses the network."""
    habits = {
        0: Habits(leaves=0.7),
        1: Habits(leaves=1.5, beacon=None),
        2: Habits(leaves=1.0, beacon=0.5, back=0.0),
        3: Habits(offline=(0.5, 15.0), tabs=2),
    }
    world, came = crowd(60, 20, habits=lambda number: habits.get(number % 10, Habits()))
    assert_fair(world, came)
    gone = {person.visit.user: person for person in came if person.visit.reason}
    assert len(gone) >= 6
    for one in lobby.formed(world.platform.documents.kept, PAIRS):
        formed = datetime.fromisoformat(one.formed)
        for person in (gone[member.user_id] for member in one.members if member.user_id in gone):
            assert any(formed - timedelta(seconds=3) <= at <= formed for at in person.asked_at), person.visit.user


def test_participants_with_two_tabs_each_are_matched_once():
    world, came = crowd(20, 10, habits=lambda number: Habits(tabs=2))
    assert_fair(world, came)
    assert in_groups(world, came) == (20, 0)


def test_in_an_account_with_ten_executions_all_are_matched():
    small = {name: wire._replace(concurrency=2) for name, wire in WIRES.items()}
    world, came = crowd(40, 30, concurrency=10, wires=small)
    assert_fair(world, came)
    assert in_groups(world, came) == (40, 0)


def test_a_participant_in_the_lobby_sees_that_the_study_is_closed():
    world = SimulatedWorld(SEED, None, PAIRS)
    one = SimulatedMember(world, 0)
    world.clock.spawn(one.walk)
    world.clock.after(90, world.close)
    world.settle(7200)
    assert MASTER_LIST in world.platform.documents.kept
    assert one.visit.reason, world.story()
    assert not any(world.left().values()), world.left()


def test_the_simulated_lobby_page_asks_as_often_as_the_real_one():
    script = (Path(__file__).parents[2] / "hippodrome" / "web" / "game" / "lobby.js").read_text(encoding="utf-8")
    told = dict(re.findall(r"const (ASK_EVERY|CONFIRM_AFTER) = ([\d_]+);", script))
    milliseconds = {name: float(value.replace("_", "")) for name, value in told.items()}
    assert milliseconds == {"ASK_EVERY": 1000 * POLL, "CONFIRM_AFTER": 1000 * PROPOSED_POLL}


# The checks themselves


class Judged:
    """The documents of a pair that has played without faults, for tests to change."""

    def __init__(self):
        self.world, self.came = crowd(2, 1)
        self.kept = self.world.platform.documents.kept
        (self.session,) = lobby.formed(self.kept, PAIRS)

    @property
    def wrong(self):
        return [text.split(":")[0] for text in session_checks.faults(self.kept, PAIRS, self.came)]

    def write(self, key, body):
        self.kept[key] = (body, "etag", self.world.clock.now())


def test_a_pair_without_faults_passes_the_checks():
    assert Judged().wrong == []


def test_the_checks_report_a_member_without_a_membership_as_split():
    judged = Judged()
    del judged.kept[membership_key("study", "p00000")]
    assert judged.wrong == ["split"]


def test_the_checks_report_a_member_of_two_sessions_as_merged():
    judged = Judged()
    other = SessionDocument("s." + 20 * "1", 2, judged.session.members, formed=judged.session.formed)
    judged.write(session_key("study", other.id), other.to_json())
    assert judged.wrong.count("merged") == 2


def test_the_checks_report_a_session_with_too_many_members_as_merged():
    judged = Judged()
    members = (*judged.session.members, Seated("p00002", None, 2))
    larger = SessionDocument(judged.session.id, 3, members, formed=judged.session.formed)
    judged.write(session_key("study", larger.id), larger.to_json())
    assert "merged" in judged.wrong


def test_the_checks_report_a_session_with_too_few_members_as_split():
    judged = Judged()
    smaller = SessionDocument(judged.session.id, 2, judged.session.members[:1], formed=judged.session.formed)
    judged.write(session_key("study", smaller.id), smaller.to_json())
    assert "split" in judged.wrong


def test_the_checks_report_a_member_who_had_not_asked_for_long_as_a_ghost():
    judged = Judged()
    judged.came[0].asked_at = judged.came[0].asked_at[:1]
    assert judged.wrong == ["ghost"]


def test_the_checks_report_an_answer_of_another_session_as_split():
    judged = Judged()
    judged.write(answer_key("study", "p00001", "3"), json.dumps({"answers": {"session": "s." + 20 * "1"}}).encode())
    assert judged.wrong == ["split"]


def test_the_checks_report_a_pair_that_its_trial_refuses_as_stranded(monkeypatch):
    monkeypatch.setattr(SimTrial, "connect", lambda trial, user, token: False)
    _, outcome = faults.run(faults.JOURNEYS_OF_GROUPS[0], SEED)
    assert not outcome.well
