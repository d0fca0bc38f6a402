"""Drives the core of a session's trial by hand: two or more members, and an agent that answers when a test tells it to."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace

import numpy as np

from hippodrome.protocol.session import Member
from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import (
    Begun,
    Call,
    OpenRecording,
    RecordLine,
    ReplayCall,
    Replayed,
    ResetCall,
    SaveAnswer,
    SaveMember,
    SendDone,
    SendMessage,
    SendState,
    StepCall,
    StepTaken,
)
from hippodrome.trial.core.players import Player, View
from hippodrome.trial.core.timing import Window
from hippodrome.trial.core.trial import Trial
from hippodrome.trial.settings import TrialSettings

SPACE = ("noop", "up", "right")
UI = dict.fromkeys(("start", "pause", "stop", "reset", "good", "bad", "up", "right"), True)
FRAME = np.zeros((2, 2, 3), np.uint8)


class SessionDriver:
    """A trial of `count` members P0, P1 … who play left, right … Members in `vacant` places have not been found.

    The data of members in `erased` places were erased.
    """

    NAMES = ("left", "right", "third", "fourth")

    def __init__(self, count=2, *, vacant=(), erased=(), recorded=None, turns=None, answered=None, **section):
        self.names = self.NAMES[:count]
        section = {
            "game": "grid", "betweenEpisodes": 0, "ui": UI, "startingFrameRate": 10, "players": dict.fromkeys(self.names, "human"),
            "countdown": 3, "absent": 30, "gather": 60, **section,
        }  # fmt: skip
        sid = "s." + "0" * 20
        env = {"PROJECT_ID": "study", "USER_ID": "", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x"}
        settings = TrialSettings.from_env({**env, "TLS": "off", "SESSION": sid, "TRIAL": json.dumps(section)})
        places = {f"P{number}": name for number, name in enumerate(self.names) if name not in (*vacant, *erased)}
        members = tuple(Member(human, None, self.names.index(name)) for human, name in places.items())
        self.settings = replace(settings, members=members, players=count)
        self.places = places
        self.trial = Trial(self.settings, "3", trial_id="the-trial", new_seed=lambda: 7)
        self.now = 100.0
        self.all = []
        self.kinds = Counter()
        self.effects = []
        self.turns = turns
        self.steps = 0
        self.answered = set()
        self.stores = True
        players = tuple(
            Player(name, SPACE, (self.settings.trial.substitute or "idle") if name in vacant else "human")
            for name in self.names
        )
        seats = {"places": places, "vacant": tuple(vacant), "erased": tuple(erased)}
        self.event("start", players, recorded, self.now, **seats, answered=answered)
        self.answer_calls()

    def view(self):
        act = self.names if self.turns is None else (self.turns[self.steps % len(self.turns)],)
        return View(frozenset(act), dict.fromkeys(self.names, self.steps), {name: {} for name in self.names})

    def event(self, name, *args, **named):
        self.effects = getattr(self.trial, name)(*args, **named)
        done = 0
        while done < len(self.effects):
            effect = self.effects[done]
            if isinstance(effect, OpenRecording):
                self.effects += self.trial.recording_opened(self.now)
            done += 1
        self.all += self.effects
        self.kinds.update(map(type, self.effects))
        return self.effects

    def answer_calls(self):
        """Let the agent and the store answer their calls, but take no step."""
        while True:
            call = self.trial._agent.call
            if isinstance(call, ResetCall):
                self.steps = 0
                self.event("call_returned", call, Begun(b"reset", FRAME, self.view()), self.now)
            elif isinstance(call, ReplayCall):
                self.steps = len(call.unfinished.steps)
                self.event("call_returned", call, Replayed(FRAME, self.view()), self.now)
            elif call is not None and not isinstance(call, StepCall):
                call.heard = len(call.feedback)
                self.event("call_returned", call, None, self.now)
            elif self.saving:
                self.event("answer_saved", self.now)
            else:
                return self

    @property
    def saving(self):
        return self.stores and self.count(SaveAnswer) and not self.trial.done

    def count(self, kind):
        return self.kinds[kind]

    def come(self, *numbers):
        for number in numbers:
            self.event("connect", f"P{number}", f"tab{number}", Window(), self.now)
        return self.answer_calls()

    def go(self, *numbers):
        for number in numbers:
            self.event("disconnect", f"tab{number}", self.now)
        return self.answer_calls()

    def say(self, number, **message):
        self.event("receive", f"tab{number}", messages.parse(json.dumps(message)), self.now)
        return self.answer_calls()

    def round_trip(self, number, seconds):
        self.event("round_trip", f"P{number}", seconds, self.now)
        return self.answer_calls()

    def wait(self, seconds):
        """Let time pass; take each step that is due meanwhile."""
        self.take()
        until = self.now + seconds
        while self.trial.wake_at is not None and self.trial.wake_at <= until:
            self.now = max(self.now, self.trial.wake_at)
            self.event("advance", self.now)
            self.answer_calls()
            self.take()
        self.now = until
        self.event("advance", self.now)
        self.answer_calls()
        return self.take()

    def take(self, *, rewards=None, terminated=False):
        """Take the step that has begun, if one has."""
        call = self.trial._agent.call
        if isinstance(call, StepCall):
            self.steps += 1
            call.heard = len(call.feedback)
            paid = dict.fromkeys(self.names, 0.0) | (rewards or {})
            self.event("call_returned", call, StepTaken(paid, terminated, False, FRAME, b"step", self.view()), self.now)
            self.answer_calls()
        return self

    def begin(self):
        """Let all members come, and the countdown end; no step was taken."""
        self.come(*range(len(self.places)))
        self.now += self.settings.trial.countdown
        self.event("advance", self.now)
        return self.answer_calls()

    def state_seen_by(self, number):
        """Return the newest state of the trial that the member was sent."""
        tab, latest_first = f"tab{number}", reversed(self.all)
        texts = (e.text for e in latest_first if isinstance(e, SendState | SendMessage) and e.connection == tab)
        return next(said for said in map(json.loads, texts) if "state" in said)

    def errors(self, number):
        texts = [e.text for e in self.all if isinstance(e, SendMessage) and e.connection == f"tab{number}"]
        return [said["error"] for said in map(json.loads, texts) if "error" in said]

    def done(self, number):
        found = [effect for effect in self.all if isinstance(effect, SendDone) and effect.connection == f"tab{number}"]
        return found[-1] if found else None

    def lines(self, kind):
        return [effect.fields for effect in self.all if isinstance(effect, RecordLine) and effect.kind == kind]

    def presence(self):
        return [(line["player"], line["what"]) for line in self.lines("presence")]

    @property
    def taken(self):
        """The calls of the steps that have begun."""
        return [effect for effect in self.all if isinstance(effect, StepCall)]

    @property
    def answers(self):
        """Every answer that was stored, by the members' ids."""
        found = []
        for effect in self.all if self.count(SaveAnswer) or self.count(SaveMember) else ():
            if isinstance(effect, SaveAnswer):
                found += effect.by_human.items()
            elif isinstance(effect, SaveMember):
                found.append((effect.human, effect.answers))
        return found

    @property
    def outcomes(self):
        return {human: answers["outcome"] for human, answers in self.answers}

    def calls(self, kind=Call):
        return [effect for effect in self.all if isinstance(effect, kind)]
