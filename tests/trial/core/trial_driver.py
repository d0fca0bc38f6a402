"""Drives the core of a trial by hand, for tests that look at its decisions."""

import json

import numpy as np

from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import (
    Begun,
    Call,
    OpenRecording,
    RecordLine,
    ResetCall,
    SendMessage,
    StepCall,
    StepTaken,
)
from hippodrome.trial.core.history import Episode, RecordedStep, RecordedTrial, UnfinishedEpisode
from hippodrome.trial.core.players import PLAYER, alone
from hippodrome.trial.core.timing import Window
from hippodrome.trial.core.trial import Trial
from hippodrome.trial.settings import TrialSettings

SPACE = ("noop", "up", "right")
UI = dict.fromkeys(("start", "pause", "stop", "reset", "good", "bad", "up", "right", "fpsUp"), True)
FRAME = np.zeros((2, 2, 3), np.uint8)


class Driver:
    """Drives a trial by hand, with an agent that answers when a test tells it to, and a clock that the test sets."""

    def __init__(self, *, assets=(), variables=None, **section):
        section = {"game": "grid", "betweenEpisodes": 0, "ui": UI, "startingFrameRate": 10, **section}
        env = {"PROJECT_ID": "study", "USER_ID": "P1", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x"}
        settings = TrialSettings.from_env({**env, "TLS": "off", "TRIAL": json.dumps(section), **(variables or {})})
        self.trial = Trial(settings, "3", trial_id="the-trial", new_seed=lambda: 7, assets=assets)
        self.now = 100.0
        self.effects = []
        self.all = []

    def event(self, name, *args):
        """Bring an event; return its effects, and those of the recordings that it opens."""
        self.effects = getattr(self.trial, name)(*args)
        for effect in self.effects:
            if isinstance(effect, OpenRecording):
                self.effects += self.trial.recording_opened(self.now)
        self.all += self.effects
        return self.effects

    def begin(self, recorded=None):
        self.event("start", alone(SPACE), recorded, self.now)
        return self

    def connect(self, connection="tab", player="P1", window=None):
        return self.event("connect", player, connection, window or Window(), self.now)

    def say(self, connection="tab", **message):
        return self.event("receive", connection, messages.parse(json.dumps(message)), self.now)

    def wait(self, seconds):
        self.now += seconds
        return self.event("advance", self.now)

    def returns(self, result=None):
        return self.event("call_returned", self.call, result, self.now)

    def fails(self, error):
        return self.event("call_failed", self.call, error, self.now)

    def reset(self):
        assert isinstance(self.call, ResetCall)
        return self.returns(Begun(b"reset", FRAME))

    def step(self, reward=1.0, terminated=False):
        """Wait for the step that is due, and take it."""
        if not isinstance(self.call, StepCall):
            self.wait(self.trial.wake_at - self.now)
        call = self.call
        call.heard = len(call.feedback)
        return self.returns(StepTaken({PLAYER: reward}, terminated, False, FRAME, b"step"))

    def playing(self):
        """Connect a client and start the game; no step was taken."""
        self.begin()
        self.reset()
        self.connect()
        self.say(command="start")
        return self

    @property
    def call(self):
        """The call that the agent was given last."""
        return [effect for effect in self.all if isinstance(effect, Call)][-1]

    def of(self, kind):
        return [effect for effect in self.effects if isinstance(effect, kind)]

    def records(self, kind):
        return [effect.fields for effect in self.all if isinstance(effect, RecordLine) and effect.kind == kind]


def sent(effects, kind=SendMessage):
    return [json.loads(effect.text) for effect in effects if isinstance(effect, kind)]


def recorded(steps, unheard=()):
    unfinished = UnfinishedEpisode(2, 11, steps, list(unheard))
    return RecordedTrial([Episode(1, 5, 3.0, "terminated")], unfinished, seconds=4.0)


STEPS = [RecordedStep(1, 1, 1.0), RecordedStep(None, 0, 0.5)]
