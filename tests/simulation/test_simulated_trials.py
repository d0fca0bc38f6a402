"""The simulated trials of sessions behave like real ones, as far as the control plane can notice."""

from __future__ import annotations

import json

import msgspec
import pytest

from hippodrome.control.ports import TaskRequest
from hippodrome.protocol.keys import answer_key, session_key
from hippodrome.protocol.session import Member, SessionDocument, member_token
from testing.clock import EPOCH
from testing.simulation.conditions import Conditions
from testing.simulation.trials import ABSENT, COUNTDOWN
from testing.simulation.world import PROJECT, SimulatedWorld
from testing.tasks import Life

SESSION, STEP, PLAY = "s." + 20 * "0", "3", 30.0
PAIR = ("alice", "bob")


class Played:
    """A world with the running server of one session."""

    def __init__(self, **conditions):
        self.world = SimulatedWorld(
            1, Conditions(interrupted=0.0, **conditions), msgspec.structs.replace(PROJECT, players=2)
        )
        self.documents = self.world.platform.documents
        self.task = self.serve("a-1")

    def serve(self, name):
        """Start a server of the session; its task when it runs."""
        tasks, made = self.world.platform.tasks, []
        until = str(EPOCH.timestamp() + 7200)
        variables = {"DEADLINE": until, "TOKEN": f"token of {name}", "SESSION": SESSION}
        request = TaskRequest(name, "family", "cluster", 1, 2, variables)
        self.world.clock.spawn(lambda: made.append(tasks.tasks[tasks.run(request)]))
        while not made or made[0].last is not Life.RUNNING:
            self.world.run(self.world.clock.seconds + 1)
        return made[0]

    def form(self, *members):
        document = SessionDocument(SESSION, 2, tuple(Member(user, None, seat) for seat, user in enumerate(members)))
        self.documents.keep(session_key("study", SESSION), document.to_json())

    def trial(self, task=None):
        return self.world.trials.at(task or self.task, STEP, PLAY)

    def connect(self, user, token=None, task=None):
        return self.trial(task).connect(
            user, token or member_token((task or self.task).request.environment["TOKEN"], user)
        )

    def run(self, seconds):
        self.world.run(self.world.clock.seconds + seconds)

    def play(self, seconds):
        """Let both members connect and play for so long."""
        self.form(*PAIR)
        for user in PAIR:
            self.connect(user)
        self.run(COUNTDOWN + seconds)

    def outcomes(self):
        kept = self.documents.kept
        stored = {user: kept.get(answer_key("study", user, STEP)) for user in PAIR}
        return {user: json.loads(found[0])["answers"]["outcome"] for user, found in stored.items() if found}


def test_there_is_no_trial_before_the_session_is_formed():
    played = Played()
    assert played.trial() is None
    played.form(*PAIR)
    assert played.trial() is played.trial()


def test_only_members_are_admitted_each_with_their_own_token():
    played = Played()
    played.form(*PAIR)
    token = played.task.request.environment["TOKEN"]
    assert not played.connect("alice", token)
    assert not played.connect("alice", member_token(token, "bob"))
    assert not played.connect("carol")
    assert played.connect("alice")


def test_the_game_waits_for_all_members_and_then_each_has_an_answer():
    played = Played()
    played.form(*PAIR)
    played.connect("alice")
    played.run(ABSENT - 5)
    assert played.world.trials.played[SESSION, STEP] == 0
    played.connect("bob")
    played.run(COUNTDOWN + PLAY + 2)
    assert played.outcomes() == {"alice": "finished", "bob": "finished"}
    played.run(120)
    assert played.task.last is Life.STOPPED


def test_a_member_who_stays_away_ends_the_game_for_all():
    played = Played()
    played.play(10)
    played.trial().disconnect("bob")
    played.run(ABSENT - 5)
    assert played.outcomes() == {}
    played.run(10)
    assert played.outcomes() == {"alice": "partnerLeft", "bob": "left"}


def test_a_member_who_comes_back_in_time_goes_on():
    played = Played()
    played.play(10)
    played.trial().disconnect("bob")
    played.run(ABSENT - 5)
    played.connect("bob")
    played.run(COUNTDOWN + PLAY)
    assert played.outcomes() == {"alice": "finished", "bob": "finished"}


def test_the_next_server_goes_on_where_the_first_was_lost():
    played = Played()
    played.play(PLAY / 2)
    lost = played.trial()
    played.world.platform.tasks.end(played.task.arn, "SpotInterruption", "")
    played.run(30)
    assert lost.over == "lost"
    recorded = played.world.trials.played[SESSION, STEP]
    assert PLAY / 3 < recorded < PLAY
    second = played.serve("a-2")
    for user in PAIR:
        played.connect(user, task=second)
    played.run(COUNTDOWN + PLAY - recorded + 2)
    assert played.outcomes() == {"alice": "finished", "bob": "finished"}


@pytest.mark.parametrize("formed", [True, False], ids=["formed", "not formed yet"])
def test_a_server_to_which_no_member_comes_ends_once_its_session_is_formed(formed):
    played = Played(idle=100.0)
    if formed:
        played.form(*PAIR)
    played.run(300)
    assert (played.task.last is Life.STOPPED) is formed
