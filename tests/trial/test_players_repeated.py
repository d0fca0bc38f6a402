"""A recording of several players is enough to repeat the game: the environment's steps and the policies' choices.

The core plays with an agent and policies of agent.py, on a set clock. Policies answer when an example says so, so they
may be late, and they observe while the environment has gone on.
"""

from __future__ import annotations

import json
from collections import defaultdict, deque
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from testing.exploration import examples
from trial.agent.agent import AgentAdapter
from trial.agent.joint import JointAdapter
from trial.agent.joint_calls import JointCalls
from trial.agent.starting import start
from trial.core import messages
from trial.core.effects import Call, OpenRecording, RecordLine, ResetPolicy, SaveAnswer, WriteLine
from trial.core.flow_control import Window
from trial.core.players import who_plays
from trial.core.policies import AskPolicy
from trial.core.trial import Trial
from trial.core.unfinished import RecordedTrial
from trial.policies.seats import load_policies
from trial.recordings.recorder import rules
from trial.recordings.recording import read_observation
from trial.recordings.resume import add_lines
from trial.settings import Settings

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

    def act(self, observation, info, mask):
        self.state = (31 * self.state + 7 * int(observation[0]) + int(observation[1]) + info["t"]) % 997
        if self.state % 7 == 0:
            raise ValueError("no idea")
        legal = [index for index in range(4) if mask is None or mask[index]]
        return legal[self.state % len(legal)]
'''
SPACE = ["noop", "up", "right", "down"]
PLAYS = {"me": "human", "it": "agent:Partner", "dice": "random"}


class Game:
    """A trial with three players of AGENT. `earlier` are the lines that another server recorded."""

    def __init__(self, folder: Path, section: dict[str, Any], earlier: list[dict[str, Any]] | None = None) -> None:
        env = {"PROJECT_ID": "study", "USER_ID": "P1", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x"}
        section = {
            "game": "x", "actionSpace": SPACE, "players": PLAYS, "betweenEpisodes": 0, "startingFrameRate": 10,
            "seed": 5, "maxEpisodes": 2, "recordObservations": True, **section,
            "ui": dict.fromkeys(("start", "pause", "up", "down", "left", "right"), True),
        }  # fmt: skip
        self.settings = Settings.from_env({**env, "TLS": "off", "TRIAL": json.dumps(section)})
        self.trial = Trial(self.settings, "3", trial_id="t", new_seed=lambda: 7)
        agent = adapter(folder)
        spaces = {name: agent.action_spaces[name] for name in agent.players}
        self.players = who_plays(self.settings.trial, spaces, None)
        self.policies = load_policies(self.players, folder, agent.agent_module, {})
        self.calls = JointCalls(agent, self.players, dict, record_observations=True)
        self.waiting: dict[str, deque[Any]] = defaultdict(deque)  # what each policy has not come to yet
        self.head: dict[str, Any] = {}
        self.lines: list[dict[str, Any]] = []
        self.now = 100.0
        recorded = None
        if earlier is not None:
            recorded = RecordedTrial()
            add_lines(recorded, earlier)
        self.event("start", self.players, recorded, self.now)
        self.event("connect", "P1", "tab", Window(), self.now)
        self.say(command="start")

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

    def say(self, **message: Any) -> None:
        self.event("receive", "tab", messages.parse(json.dumps(message)), self.now)

    def tick(self) -> None:
        self.now += 0.1
        self.event("advance", self.now)

    def answers(self, player: str) -> None:
        """The policy comes to what it was told, up to the next question, and answers that."""
        policy, waiting = self.policies[player], self.waiting[player]
        while waiting:
            effect = waiting.popleft()
            if isinstance(effect, ResetPolicy):
                policy.reset(effect.seed)
                for seen in effect.observed:
                    chosen(policy, seen.observation, seen.info, seen.mask)
                continue
            action = chosen(policy, effect.observation, effect.info, effect.mask)
            if isinstance(action, Exception):
                return self.event("policy_failed", player, effect.ask_id, action, self.now)
            return self.event("policy_acted", player, effect.ask_id, action, self.now)

    def does(self, what: tuple[str, Any]) -> None:
        name, value = what
        if name == "tick":
            self.tick()
        elif name == "answers":
            self.answers(value)
        else:
            self.say(action=value, **({} if name == "press" else {"held": name == "down"}))

    @property
    def steps(self) -> list[dict[str, Any]]:
        return [line for line in self.lines if line["kind"] == "step"]


def chosen(policy: Any, *seen: Any) -> Any:
    """What the policy chooses, or the exception that it raises."""
    try:
        return policy.act(*seen)
    except ValueError as error:
        return error


def adapter(folder: Path) -> JointAdapter:
    (folder / "agent.py").write_text(AGENT)
    found = start(AgentAdapter(folder, "x", tuple(SPACE)), tuple(PLAYS))
    assert isinstance(found, JointAdapter)
    return found


def repeat(folder: Path, head: dict[str, Any], lines: list[dict[str, Any]]) -> None:
    """Play what was recorded again, by the recording alone; assert that it is the same."""
    agent = adapter(folder)
    config = Settings.from_env(
        {"PROJECT_ID": "s", "USER_ID": "P", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x",
         "TLS": "off", "TRIAL": json.dumps({"game": "x", "players": PLAYS, "actionSpace": SPACE})}
    ).trial  # fmt: skip
    players = who_plays(config, {name: agent.action_spaces[name] for name in agent.players}, None)
    policies = load_policies(players, folder, agent.agent_module, {})
    seen: list[Any] = []
    for line in lines:
        if line["kind"] == "reset":
            joint, _ = agent.reset(line["seed"])
            for name, policy in policies.items():
                policy.reset(line["players"][name]["seed"])
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


DEEDS = st.one_of(
    st.just(("tick", None)),
    st.tuples(st.just("answers"), st.sampled_from(["it", "dice"])),
    st.tuples(st.sampled_from(["press", "down", "up"]), st.sampled_from(["up", "right"])),
)
SECTIONS = st.fixed_dictionaries(
    {
        "pace": st.sampled_from(["realtime", "turns"]),
        "frameSkip": st.integers(1, 3),
        "input": st.sampled_from(["held", "single"]),
        "idleAction": st.sampled_from(["noop", "down"]),
        "turnEnds": st.sampled_from(["idle", "random"]),
        "turnSeconds": st.just(0.3),
        "policySeconds": st.just(0.2),
    }
)


@settings(max_examples=examples(120))
@given(section=SECTIONS, deeds=st.lists(DEEDS, min_size=30, max_size=90))
def test_a_game_of_several_can_be_repeated_from_its_recording_alone(
    tmp_path_factory: pytest.TempPathFactory, section: dict[str, Any], deeds: list[Any]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    game = Game(folder, section)
    for deed in deeds:
        game.does(deed)
    repeat(folder, game.head, game.lines)


@settings(max_examples=examples(80))
@given(section=SECTIONS, before=st.lists(DEEDS, min_size=10, max_size=40), after=st.lists(DEEDS, min_size=20))
def test_so_can_one_that_another_server_went_on_with(
    tmp_path_factory: pytest.TempPathFactory, section: dict[str, Any], before: list[Any], after: list[Any]
) -> None:
    folder = tmp_path_factory.getbasetemp()
    first = Game(folder, section)
    for deed in before:
        first.does(deed)
    second = Game(folder, section, earlier=first.lines)
    for deed in after:
        second.does(deed)
    played = {line["episode"] for line in first.steps}
    begun = {line["episode"] for line in second.lines if line["kind"] == "reset"}
    assert not played & begun, "no episode begins again"
    repeat(folder, first.head, first.lines + second.lines)


def test_a_recording_says_when_each_player_was_terminated_or_truncated(tmp_path: Path) -> None:
    game = Game(tmp_path, {})
    while len(game.steps) < 14:
        game.tick()
    ends = [
        (line["step"], name, key)
        for line in game.steps
        for name, part in line["players"].items()
        for key in ("terminated", "truncated")
        if part.get(key)
    ]
    assert ends == [(6, "it", "terminated"), (9, "me", "truncated"), (14, "dice", "terminated")]
    assert [line["step"] for line in game.steps if line["terminated"]] == [14], "the line itself says it of the episode"
