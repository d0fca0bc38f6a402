"""Loads the policies of a trial's players, asks them for actions, and describes them for recordings."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.protocol.file_names import on_disk
from hippodrome.protocol.players import AGENT_PLAYER, ALL_KINDS, SAMPLE, files_there
from hippodrome.trial.core.effects import ResetPolicy
from hippodrome.trial.core.players import Mask, Player
from hippodrome.trial.core.policies import AskPolicy, Observed
from hippodrome.trial.policies.policy import IdlePolicy, Policy, PolicyError, PolicyFileMissing, RandomPolicy, of_class

Done = Callable[[int, int | None, Exception | None], None]
"""A function that gets the id of a question, and the action, or None and the policy's exception."""
Acted = Callable[[str, int, int | None, Exception | None], None]
"""A function that gets the player, the id of a question, and the action, or None and the policy's exception."""


def load_policies(
    players: Iterable[Player], folder: Path, agent_module: Any, observation_spaces: Mapping[str, Any]
) -> dict[str, Policy]:
    """Load the policies of all players that have one, by player. It blocks the thread that calls it.

    Raises PolicyError with a sentence that names the player, and whatever the researcher's classes raise.
    """
    loaded = {}
    for player in players:
        if player.human or player.by_program:
            continue
        count, space = len(player.action_space), observation_spaces.get(player.name)
        try:
            loaded[player.name] = load(
                player.plays, folder, agent_module, count, space, player=player.name, idle=player.idle
            )
        except PolicyError as error:
            raise PolicyError(f"trial.players: {player.name} cannot be played by {player.plays}: {error}") from error
    return loaded


def load(
    spec: str,
    folder: Path,
    agent_module: Any,
    action_count: int,
    observation_space: Any = None,
    *,
    player: str = "player_1",
    idle: int = 0,
) -> Policy:
    """Make the policy `spec` for one player: `random`, `idle`, `agent:Class`, `FILE.onnx` or `sample:FILE.onnx`.

    `folder` is the project's, `agent_module` the imported agent.py (None without one), `observation_space` the
    player's space (None if it is not known), and `idle` the number of the player's idle action. A file is tried with
    one observation of zeros, if the space is known. Raises PolicyError with a sentence for the researcher, and whatever
    the researcher's class raises.
    """
    if spec == "random":
        return RandomPolicy(action_count)
    if spec == "idle":
        return IdlePolicy(action_count, idle)
    if spec.startswith(AGENT_PLAYER):
        return of_class(spec, agent_module, player, action_count)
    if spec.endswith(".onnx"):
        from hippodrome.trial.policies import onnx  # noqa: PLC0415 - it imports onnxruntime, which most projects do not need

        name = spec.removeprefix(SAMPLE)
        return onnx.load(spec, _file(folder, name), action_count, observation_space, sample=spec != name)
    raise PolicyError(f"{spec!r} is no player; write {ALL_KINDS}")


def _file(folder: Path, name: str) -> Path:
    """Find the file of this name in the folder or below it. Raises PolicyError if there is none."""
    path = on_disk(folder, name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise PolicyError(f"{name} leads out of the project's folder")
    if not path.is_file():
        raise PolicyFileMissing(f"there is no file {name}{files_there(folder)}")
    return path


class Places:
    """Asks the policies of one trial. Its methods are for the event loop, which calls `acted` too."""

    def __init__(self, acted: Acted) -> None:
        self._acted = acted
        self._policies: dict[str, PolicyThread | InlinePolicy] = {}
        self.described: dict[str, Mapping[str, Any]] = {}
        """The description of each player, for the header of a recording."""

    @property
    def busy(self) -> bool:
        """Whether a method of a policy has not returned yet. It may never return."""
        return any(policy.busy for policy in self._policies.values())

    def fill(
        self,
        players: Iterable[Player],
        policies: Mapping[str, Policy],
        stand_ins: Mapping[str, Policy],
        seats: Sequence[str],
    ) -> None:
        """Set who plays. From then on each policy belongs to this trial alone.

        `policies` and `stand_ins` are by player; a stand-in plays while the player's human is away. `seats` has the
        players of the session's members, in the order of their seats.
        """
        for player in players:
            policy, stand_in = policies.get(player.name), stand_ins.get(player.name)
            self.described[player.name] = described = _described(player, policy, stand_in)
            if player.name in seats:
                described["seat"] = seats.index(player.name)
            either = policy or stand_in
            if either is not None:
                self._policies[player.name] = self._running(player, either)

    def _running(self, player: Player, policy: Policy) -> PolicyThread | InlinePolicy:
        def done(ask_id: int, action: int | None, error: Exception | None) -> None:
            self._acted(player.name, ask_id, action, error)

        if isinstance(policy, RandomPolicy | IdlePolicy):
            return InlinePolicy(policy, done)
        return PolicyThread(policy, done, name=f"policy of {player.name}")

    def ask(self, effect: AskPolicy) -> None:
        """Ask a policy for an action. `acted` is called with the answer."""
        self._policies[effect.player].ask(effect.ask_id, effect.observation, effect.info, effect.mask)

    def reset(self, effect: ResetPolicy) -> None:
        """Begin an episode for a policy, or resume it after a replay."""
        self._policies[effect.player].reset(effect.seed, effect.observed)

    def close(self) -> None:
        """Close all policies: the trial is over."""
        for policy in self._policies.values():
            policy.close()


def _described(player: Player, policy: Policy | None, stand_in: Policy | None) -> dict[str, Any]:
    if stand_in is not None:
        return {"kind": "human", "substitute": stand_in.description()}
    if player.human:
        return {"kind": "human"}
    if policy is None:
        return {"kind": "program", "policy": player.plays}
    return {"kind": "policy", "policy": player.plays, **policy.description()}


class InlinePolicy:
    """Asks a policy whose methods return at once, on the event loop. Has the same methods as `PolicyThread`."""

    busy = False

    def __init__(self, policy: Policy, done: Done) -> None:
        self.policy = policy
        self._done = done
        self._loop = asyncio.get_running_loop()

    def ask(self, ask_id: int, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> None:
        """Ask for an action. The event loop then calls `done(ask_id, action, None)`."""
        self._loop.call_soon(self._done, ask_id, self.policy.act(observation, info, mask), None)

    def reset(self, seed: int, observed: Sequence[Observed] = ()) -> None:
        """Begin an episode, or resume it after the choices `observed`."""
        self.policy.reset(seed)
        self.policy.resume(observed)

    def close(self) -> None:
        """Close the policy."""
        self.policy.close()


class PolicyThread:
    """Asks one policy, one question after another, on a thread of its own. Its methods are for the event loop.

    The event loop calls `done` once for each question, in their order. The thread is a daemon: a policy that never
    returns delays only its own answers, and cannot keep the process alive.
    """

    def __init__(self, policy: Policy, done: Done, *, name: str = "policy") -> None:
        self.policy = policy
        self._done = done
        self._loop = asyncio.get_running_loop()
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._closed = False
        self._running = False
        self._reset_error: Exception | None = None  # what the latest reset raised; only the thread uses it
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a method of the policy has not returned yet. It may never return."""
        return self._running

    def ask(self, ask_id: int, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> None:
        """Ask for an action. `done(ask_id, action, error)` is called later, unless `close` is called before."""

        def answer() -> None:
            try:
                if self._reset_error is not None:
                    raise self._reset_error
                action, error = self.policy.act(observation, info, mask), None
            except BaseException as problem:  # noqa: BLE001 - the researcher's code may raise anything
                action, error = None, _plain(problem)
            self._tell(ask_id, action, error)

        self._jobs.put(answer)

    def reset(self, seed: int, observed: Sequence[Observed] = ()) -> None:
        """Begin an episode, or resume it after the choices `observed`, for the questions from now on.

        If the policy's `reset` or `resume` raises, they are answered by its error.
        """

        def begin() -> None:
            try:
                self.policy.reset(seed)
                if observed:
                    self.policy.resume(observed)
                self._reset_error = None
            except BaseException as problem:  # noqa: BLE001 - as above
                self._reset_error = _plain(problem)

        self._jobs.put(begin)

    def close(self) -> None:
        """End the thread after its present question. `done` is not called any more."""
        if not self._closed:
            self._closed = True
            self._jobs.put(None)

    def _tell(self, ask_id: int, action: int | None, error: Exception | None) -> None:
        def tell() -> None:
            if not self._closed:
                self._done(ask_id, action, error)

        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(tell)

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            if not self._closed:
                self._running = True
                job()
                self._running = False
        self._running = True
        with contextlib.suppress(BaseException):  # the game is over; nothing depends on how a policy ends
            self.policy.close()
        self._running = False


def _plain(problem: BaseException) -> Exception:
    """Return the exception; a RuntimeError in the place of SystemExit and others that would end the thread."""
    if isinstance(problem, Exception):
        return problem
    return RuntimeError(repr(problem)).with_traceback(problem.__traceback__)
