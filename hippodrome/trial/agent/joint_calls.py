"""Carries out the core's calls (`trial/core/effects.py`) on an agent with several players, on the agent's thread."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from hippodrome.trial.agent.calls import Calls, Diverged
from hippodrome.trial.agent.joint import Joint, JointAdapter
from hippodrome.trial.core.effects import Begun, ReplayCall, Replayed, ResetCall, StepCall, StepTaken
from hippodrome.trial.core.history import UnfinishedEpisode, Word
from hippodrome.trial.core.players import Action, Player, View, policy_seed
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.recordings import recording

_NONE: frozenset[str] = frozenset()


class JointCalls(Calls):
    """Runs calls of an agent with several players. `players` are all of them, in the environment's order.

    A line of the recording has the same fields as in a game with one player: they are about the first human. The
    further field `players` is about all players.
    """

    def __init__(
        self,
        agent: JointAdapter,
        players: Sequence[Player],
        stamp: Callable[[], dict[str, Any]],
        *,
        record_observations: bool,
        stand_ins: Iterable[str] = (),
    ) -> None:
        """`stand_ins` are players for whom a policy may play while their participant is away."""
        super().__init__(stamp, record_observations=record_observations)
        self._agent = agent
        humans = tuple(player.name for player in players if player.human)
        self._first_human = humans[0]
        policies = (player.name for player in players if not player.human and not player.by_program)
        self._policies = frozenset((*policies, *stand_ins))
        self._ended: frozenset[str] = frozenset()  # the players for whom the episode is over
        agent.views = humans

    def _reset(self, call: ResetCall) -> Begun:
        episode, seed = call.episode, call.seed
        joint, seeded = self._agent.reset(seed)
        self._ended = frozenset()
        pictures = self._agent.pictures()
        if self.callbacks:
            self.callbacks.episode_began(episode, joint.observations, joint.infos)
        fields: dict[str, Any] = {
            "episode": episode,
            "seed": seed if seeded else None,
            "info": recording.plain(joint.infos.get(self._first_human, {})),
            **self._first_observation(joint),
            "players": {player: self._reset_part(player, call, joint) for player in self._agent.players},
            "toAct": sorted(joint.to_act),
            **call.fields,
        }
        return Begun(self._line("reset", **self._stamp(), **fields), pictures, self._view(joint))

    def _view(self, joint: Joint) -> View:
        """Build the players' view for the core, with copies: policies read it while the environment takes steps."""
        watching = self._policies & joint.to_act
        if not watching:
            return View(joint.to_act, masks=joint.masks)
        observations = {player: snapshot(joint.observations.get(player)) for player in watching}
        infos = {player: snapshot(joint.infos.get(player, {})) for player in watching}
        return View(joint.to_act, observations, infos, joint.masks)

    def _first_observation(self, joint: Joint) -> dict[str, Any]:
        """Return the field of a line with the first human's observation, if observations are recorded."""
        if not self._record_observations:
            return {}
        return {"observation": recording.observation(joint.observations.get(self._first_human))}

    def _reset_part(self, player: str, call: ResetCall, joint: Joint) -> dict[str, Any]:
        """Build one player's part of a reset's line. Policies have a seed even if the environment takes none."""
        seeded = {"seed": policy_seed(call.seed, player)} if player in call.asked else {}
        return {**seeded, **self._info_and_observation(player, joint)}

    def _info_and_observation(self, player: str, joint: Joint) -> dict[str, Any]:
        """Return a player's info and observation for their part of a line. The line itself has the first human's."""
        fields: dict[str, Any] = {}
        if player != self._first_human:
            info = joint.infos.get(player)
            if info:
                fields["info"] = recording.plain(info)
            if self._record_observations and player in joint.observations:
                fields["observation"] = recording.observation(joint.observations[player])
        return fields

    def _say(self, word: Word) -> str:
        player = word.player if word.player in self._agent.players else self._first_human
        self._agent.feedback(player, word.text)
        return player

    def _step(self, call: StepCall) -> StepTaken:
        stamp, actions, first = self._stamp(), call.actions, self._first_human
        self._give_feedback(call)
        joint = self._agent.step({player: action.index for player, action in actions.items()})
        pictures = self._agent.pictures()
        if self.callbacks:
            self._tell_step({player: action.index for player, action in actions.items() if action.acts}, joint)
        asked, truncated = actions[first], joint.over and joint.why == "truncated"
        terminated = joint.over and not truncated
        line = self._line(
            "step",
            **stamp,
            **call.fields,
            human=asked.index if asked.human else None,
            action=asked.index,
            actionName=asked.name,
            by=asked.by,
            **({"advice": asked.index} if asked.by == "advice" else {}),
            reward=joint.rewards[first],
            terminated=terminated,
            truncated=truncated or call.truncated_by is not None,
            info=joint.infos.get(first, {}),
            players={player: self._step_part(player, action, joint) for player, action in actions.items()},
            toAct=sorted(joint.to_act),
            **self._first_observation(joint),
            **(self._extra(joint.extra) if joint.extra else {}),
        )
        self._ended = _ended(joint)
        success = recording.succeeded(joint.infos.get(first, {}))
        return StepTaken(joint.rewards, terminated, truncated, pictures, line, self._view(joint), success)

    def _step_part(self, player: str, action: Action, joint: Joint) -> dict[str, Any]:
        """Build one player's part of a step's line."""
        part: dict[str, Any] = {
            "action": action.index if action.acts else None,
            "actionName": action.name if action.acts else None,
            "by": action.by if action.acts else None,
        }
        if action.observed is not None:
            part["observed"] = action.observed
        if action.pressed_at is not None:
            part["pressedAt"] = action.pressed_at
        part["reward"] = joint.rewards[player]
        if player not in self._ended:
            if joint.terminated[player]:
                part["terminated"] = True
            if joint.truncated[player]:
                part["truncated"] = True
        part |= self._info_and_observation(player, joint)
        return part

    def _tell_step(self, actions: Mapping[str, int], joint: Joint) -> None:
        assert self.callbacks is not None
        self.callbacks.stepped(actions, joint.rewards, joint.observations, joint.infos)

    def _take_again(self, call: ReplayCall) -> Replayed:
        unfinished = call.unfinished
        joint, seeded = self._agent.reset(unfinished.seed or 0)
        if not seeded or unfinished.seed is None:
            raise Diverged("the environment takes no seed")
        if self.callbacks:
            self.callbacks.episode_began(unfinished.number, joint.observations, joint.infos)
        self.repeat(self.moment)
        self._ended = frozenset()
        observed = _Observations(unfinished)
        observed.add(0, joint)
        for number, step in enumerate(unfinished.steps, 1):
            for word in step.feedback:
                self._feedback(word)
            if not step.players:
                raise Diverged("the earlier server had one player")
            taken = {name: part.action for name, part in step.players.items() if part.action is not None}
            joint = self._agent.step({**call.default_actions, **taken})
            rewards = {player: part.reward for player, part in step.players.items()}
            if joint.over or joint.rewards != rewards:
                raise Diverged("the environment plays differently now")
            if self.callbacks:
                self._tell_step(taken, joint)
            self._stepped()
            observed.add(number, joint)
            self._ended = _ended(joint)
        return Replayed(self._agent.pictures(), self._view(joint), observed.by_player)


def _ended(joint: Joint) -> frozenset[str]:
    """Return the players for whom the episode is over."""
    if True not in joint.terminated.values() and True not in joint.truncated.values():
        return _NONE
    return frozenset(player for player in joint.terminated if joint.terminated[player] or joint.truncated[player])


class _Observations:
    """Collects, while steps are taken again, the observations for which each policy had chosen its actions."""

    def __init__(self, unfinished: UnfinishedEpisode) -> None:
        # Policies' players and their actions, by the number of steps taken before.
        self._chosen: dict[int, list[tuple[str, int | None]]] = defaultdict(list)
        for step in unfinished.steps:
            for player, part in step.players.items():
                if part.observed is not None:
                    action = part.action if part.by == "policy" else None
                    self._chosen[part.observed].append((player, action))
        self.by_player: dict[str, list[Observed]] = defaultdict(list)

    def add(self, steps: int, joint: Joint) -> None:
        """Keep the observation of each policy that chose an action for `joint`, the results after `steps` steps."""
        for player, action in self._chosen.get(steps, ()):
            observation = snapshot(joint.observations.get(player))
            info = snapshot(joint.infos.get(player, {}))
            self.by_player[player].append(Observed(observation, info, joint.masks.get(player), action))


def snapshot(observation: Any) -> Any:
    """Copy an observation, so that the environment cannot change it."""
    if isinstance(observation, np.ndarray):
        return observation.copy()
    if isinstance(observation, Mapping):
        return {key: snapshot(value) for key, value in observation.items()}
    if isinstance(observation, list | tuple):
        copies = [snapshot(value) for value in observation]
        return tuple(copies) if isinstance(observation, tuple) else copies
    return observation
