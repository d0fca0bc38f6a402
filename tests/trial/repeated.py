"""A game of three players on a set clock, and the same game once more, from its recording alone.

The core plays with an agent and policies of agent.py. Policies answer when an example says so, so they may be late,
and they observe while the environment has gone on.
"""

from __future__ import annotations

import json
from collections import defaultdict, deque
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Self

from hippodrome.protocol.trial import TrialSection as Section
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.joint import JointAdapter, start
from hippodrome.trial.agent.joint_calls import JointCalls
from hippodrome.trial.core import messages
from hippodrome.trial.core.effects import Call, OpenRecording, RecordLine, ResetPolicy, SaveAnswer, WriteLine
from hippodrome.trial.core.history import RecordedTrial
from hippodrome.trial.core.players import Player, who_plays
from hippodrome.trial.core.policies import AskPolicy
from hippodrome.trial.core.trial import Trial
from hippodrome.trial.policies.places import load_policies
from hippodrome.trial.recordings.recorder import rules
from hippodrome.trial.recordings.recording import read_observation
from hippodrome.trial.recordings.resume import add_lines
from hippodrome.trial.settings import TrialSettings

AGENT = '''
import random

import numpy as np

WEIGHTS = {"me": 3, "it": 5, "dice": 11}


class Agent:
    """Every action counts, also of those who are not to act. Players leave one after the other."""

    possible_agents = ["me", "it", "dice"]

    def start(self, game):
        pass

    def reset(self, seed=None):
        self.chance, self.t, self.sum = random.Random(seed), 0, 0
        self.there = list(self.possible_agents)
        self.seen = np.zeros(2, np.int64)  # the same arrays and infos all the time, as some environments have it
        self.info = {"t": 0}
        self.look()
        return {player: self.seen for player in self.there}, self.infos()

    def look(self):
        self.seen[:] = self.t, self.sum
        self.info["t"] = self.t

    def infos(self):
        masks = {"it": [index != self.sum % 4 for index in range(4)], "dice": [True, self.sum % 2, True, False]}
        rests = {"me": self.t % 5 == 2, "it": self.t % 3 == 1}
        for player in self.there:
            self.info[player] = 0
        return {
            player: self.info | {"to_act": not rests.get(player), "action_mask": masks.get(player, [True] * 4)}
            if player != "it" else self.its(rests, masks)
            for player in self.there
        }

    def its(self, rests, masks):
        self.info.update(to_act=not rests["it"], action_mask=masks["it"])
        return self.info

    def step(self, actions):
        self.t += 1
        assert set(actions) == set(self.there)
        self.sum = (7 * self.sum + sum(WEIGHTS[name] * action for name, action in actions.items())) % 101
        self.look()
        rewards = {player: (self.sum * WEIGHTS[player] % 13) / 3 for player in self.there}
        over = self.t == 14
        terminated = {player: over for player in self.there}
        truncated = {player: False for player in self.there}
        leaves = {6: "it", 9: "me"}.get(self.t)
        if leaves:
            (terminated if leaves == "it" else truncated)[leaves] = True
        told = {player: self.seen for player in self.there}, rewards, terminated, truncated, self.infos()
        self.there = [player for player in self.there if player != leaves]
        return told

    def render(self):
        return np.zeros((2, 2, 3), np.uint8)

    def close(self):
        pass


class Partner:
    """Has a state that all it was asked since the last reset has made."""

    def reset(self, seed):
        self.state = seed % 997

    def look(self, observation, info):
        self.state = (31 * self.state + 7 * int(observation[0]) + int(observation[1]) + info["t"]) % 997

    def resume(self, steps):
        for observation, info, action in steps:
            self.look(observation, info)

    def act(self, observation, info, mask):
        self.look(observation, info)
        if self.state % 7 == 0:
            raise ValueError("no idea")
        legal = [index for index in range(4) if mask is None or mask[index]]
        return legal[self.state % len(legal)]
'''
SPACE = ["noop", "up", "right", "down"]


class Game:
    """A trial with the players of AGENT. `earlier` are the lines that another server recorded."""

    PLAYS: ClassVar[Mapping[str, str]] = {"me": "human", "it": "agent:Partner", "dice": "random"}
    SECTION: ClassVar[Mapping[str, Any]] = {
        "betweenEpisodes": 0, "startingFrameRate": 10, "seed": 5, "maxEpisodes": 2, "recordObservations": True,
        "ui": dict.fromkeys(("start", "pause", "up", "down", "left", "right"), True),
    }  # fmt: skip

    def __init__(self, folder: Path, section: dict[str, Any], earlier: list[dict[str, Any]] | None = None) -> None:
        self.settings = self.make_settings({**self.SECTION, "players": self.PLAYS, **section})
        self.trial = Trial(self.settings, "3", trial_id="t", new_seed=lambda: 7)
        agent = adapter(folder)
        self.players, self.policies = cast(agent, folder, self.settings.trial)
        humans = [player.name for player in self.players if player.human]
        stand_ins = humans if self.settings.trial.substitute else ()
        self.calls = JointCalls(agent, self.players, dict, record_observations=True, stand_ins=stand_ins)
        self.waiting: dict[str, deque[Any]] = defaultdict(deque)  # what each policy has not handled yet
        self.head: dict[str, Any] = {}
        self.lines: list[dict[str, Any]] = []
        self.now = 100.0
        recorded = None
        if earlier is not None:
            recorded = RecordedTrial()
            add_lines(recorded, earlier)
        self.begin(recorded)

    def make_settings(self, section: Mapping[str, Any]) -> TrialSettings:
        """Return the settings of the server."""
        return settings_of(section, USER_ID="P1")

    def begin(self, recorded: RecordedTrial | None) -> None:
        """Start the trial, and connect the participants."""
        raise NotImplementedError

    def event(self, name: str, *args: Any) -> None:
        effects = deque(getattr(self.trial, name)(*args))
        while effects:
            effect = effects.popleft()
            if isinstance(effect, OpenRecording):
                self.head = json.loads(json.dumps(rules(self.settings.trial, effect.players)))
                effects += self.trial.recording_opened(self.now)
            elif isinstance(effect, WriteLine):
                self.lines.append(json.loads(effect.line))
            elif isinstance(effect, RecordLine):
                self.lines.append({"kind": effect.kind, **effect.fields})
            elif isinstance(effect, AskPolicy | ResetPolicy):
                self.waiting[effect.player].append(effect)
            elif isinstance(effect, Call):
                effects += self.trial.call_returned(effect, self.calls.run(effect), self.now)
            elif isinstance(effect, SaveAnswer):
                effects += self.trial.answer_saved(self.now)

    def does(self, what: tuple[str, Any]) -> None:
        """Let one thing happen, given by its name and its value."""
        raise NotImplementedError

    def plays(self, deeds: Iterable[tuple[str, Any]]) -> Self:
        """Let all of these things happen."""
        for deed in deeds:
            self.does(deed)
        return self

    def says(self, client: str, **message: Any) -> None:
        self.event("receive", client, messages.parse(json.dumps(message)), self.now)

    def tick(self) -> None:
        self.now += 0.1
        self.event("advance", self.now)

    def answers(self, player: str) -> None:
        """Let the policy handle its resets up to the next question, and answer that."""
        policy, waiting = self.policies[player], self.waiting[player]
        while waiting:
            effect = waiting.popleft()
            if isinstance(effect, ResetPolicy):
                policy.reset(effect.seed)
                policy.resume(effect.observed)
                continue
            action = chosen(policy, effect.observation, effect.info, effect.mask)
            if isinstance(action, Exception):
                return self.event("policy_failed", player, effect.ask_id, action, self.now)
            return self.event("policy_acted", player, effect.ask_id, action, self.now)

    @property
    def steps(self) -> list[dict[str, Any]]:
        return [line for line in self.lines if line["kind"] == "step"]


def settings_of(section: Mapping[str, Any], **env: str) -> TrialSettings:
    """Return the settings of a server of the study, from this section and these variables."""
    trial = json.dumps({"game": "x", "actionSpace": SPACE, **section})
    common = {"PROJECT_ID": "study", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x", "TLS": "off"}
    return TrialSettings.from_env({**common, "TRIAL": trial, **env})


def adapter(folder: Path) -> JointAdapter:
    (folder / "agent.py").write_text(AGENT)
    found = start(AgentAdapter(folder, "x", tuple(SPACE)), tuple(Game.PLAYS))
    assert isinstance(found, JointAdapter)
    return found


def cast(agent: JointAdapter, folder: Path, section: Section) -> tuple[list[Player], dict[str, Any]]:
    """Return the players, and the policies by player, with those that may play for a participant."""
    players = list(who_plays(section, {name: agent.action_spaces[name] for name in agent.players}, None))
    substitute = section.substitute
    stand_ins = [replace(player, plays=substitute) for player in players if player.human and substitute]
    return players, dict(load_policies([*players, *stand_ins], folder, agent.agent_module, {}))


def chosen(policy: Any, *seen: Any) -> Any:
    """Return the action that the policy chooses, or the exception that it raises."""
    try:
        return policy.act(*seen)
    except ValueError as error:
        return error


def repeat(folder: Path, section: Section, head: dict[str, Any], lines: list[dict[str, Any]]) -> None:
    """Play the game again from its recording alone, and assert that it goes as recorded."""
    agent = adapter(folder)
    players, policies = cast(agent, folder, section)
    humans = {player.name for player in players if player.human}
    seen: list[Any] = []
    for line in lines:
        if line["kind"] == "presence" and line["what"] == "replaced":
            policies[line["player"]].reset(line["seed"])
        elif line["kind"] == "reset":
            joint, _ = agent.reset(line["seed"])
            for name, policy in policies.items():
                part = line["players"][name]
                if "seed" in part or name not in humans:
                    policy.reset(part["seed"])
            seen, ended = [remembered(joint)], set()
        elif line["kind"] == "step":
            parts = line["players"]
            for name, part in parts.items():
                if "observed" in part:
                    action = chosen(policies[name], *seen[part["observed"]][name])
                    assert action == part["action"] or part["by"] in ("none", "late"), (name, line["step"])
            taken = {
                name: head["idleActions"][name] if part["action"] is None else part["action"]
                for name, part in parts.items()
            }
            joint = agent.step(taken)
            assert joint.rewards == {name: part["reward"] for name, part in parts.items()}, line["step"]
            assert sorted(joint.to_act) == line["toAct"]
            for name, part in parts.items():
                now = joint.terminated[name], joint.truncated[name]
                was = (part.get("terminated", False), part.get("truncated", False))
                assert was == ((False, False) if name in ended else now), (name, line["step"])
                if any(now):
                    ended.add(name)
            if "me" in joint.observations:
                assert read_observation(line["observation"]).tolist() == joint.observations["me"].tolist()
            seen.append(remembered(joint))


def remembered(joint: Any) -> dict[str, Any]:
    return {
        name: (observation.copy(), dict(joint.infos[name]), joint.masks.get(name))
        for name, observation in joint.observations.items()
    }
