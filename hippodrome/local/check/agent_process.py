"""`python -m hippodrome.local.check.agent_process REPORT`: lets the agent play, and writes to REPORT how far it got.

Runs in a process of its own, since the agent may hang or end Python. `hippodrome/local/check/agent.py` starts it, and
`agent_report.py` reads the report.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

from hippodrome.local.check.agent_progress import AgentProgress
from hippodrome.local.check.deadline import Deadline
from hippodrome.local.check.game import CheckedGame
from hippodrome.local.check.one_player import OnePlayer
from hippodrome.protocol import environment as variables
from hippodrome.protocol import handover
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.session import MAX_PLAYERS, SessionDocument, is_session_id
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.trial_llm import LlmSection
from hippodrome.trial.agent import environments, match
from hippodrome.trial.agent.agent import AgentAdapter, AgentError
from hippodrome.trial.agent.callback_names import MODERATE, REPLY
from hippodrome.trial.agent.callbacks import Callbacks, TrialFacts
from hippodrome.trial.agent.joint import JointAdapter
from hippodrome.trial.agent.replies import TalkOfAgent
from hippodrome.trial.agent.starting import start
from hippodrome.trial.core.players import Player, who_plays
from hippodrome.trial.llm.endpoint import Endpoint, Game, NoTape
from hippodrome.trial.llm.ledger import Ledger, Moment
from hippodrome.trial.llm.partner import Partner, prompt_of
from hippodrome.trial.pictures import assets
from hippodrome.trial.pictures.assets import Assets
from hippodrome.trial.pictures.reader import PictureReader
from hippodrome.trial.server import assignment
from hippodrome.trial.settings import trial_section

LINE, MAX_PIECES = "Hello", 1_000  # what is said to the agent; the most pieces of its answer that are taken
NO_KEY_SECONDS = 2.0  # an episode that ends within these seconds without a key gets a remark

_LOOKING_UP = ("os", "collections.abc", "_collections_abc")  # where os.getenv, environ.get and `in` are implemented


class _EarlyEnviron(os._Environ[str]):
    """The class of `os.environ` until the participant is known: notes the lines of the project that read them."""

    lines: ClassVar[list[tuple[str, str, int]]] = []
    folder: ClassVar[Path]

    def __getitem__(self, key: str) -> str:
        if key in variables.PARTICIPANT:
            self._note(key)
        return super().__getitem__(key)

    def _note(self, key: str) -> None:
        frame = sys._getframe(2)
        while frame.f_back and frame.f_globals.get("__name__") in _LOOKING_UP:
            frame = frame.f_back
        path = Path(frame.f_code.co_filename)
        if path.is_relative_to(self.folder) and "site-packages" not in path.parts:
            place = (key, path.relative_to(self.folder).as_posix(), frame.f_lineno)
            if place not in self.lines:
                self.lines.append(place)


def _try(report: Path, deadline: Deadline) -> None:
    """Let the agent play, and write to the report how far it got."""
    folder = Path(os.environ[variables.AGENT_DIR])
    config = trial_section(json.loads(os.environ[variables.TRIAL]))
    progress = AgentProgress(report, folder, _EarlyEnviron.lines, deadline)
    if config.llm is not None:
        _ask_stand_in(config.llm)
    adapter = AgentAdapter(folder, config.game, config.action_space, _reader(config, folder, progress))
    handover = _handover()
    group = handover.group if handover else _group()
    usual_class, _EarlyEnviron.folder = os.environ.__class__, folder
    if handover:
        os.environ.__class__ = _EarlyEnviron
    if not progress.call("start", lambda: start(adapter, tuple(config.players_of(group)))):
        return
    player: AgentAdapter | JointAdapter = progress.result
    joint = player if isinstance(player, JointAdapter) else OnePlayer(player, masked=config.pace == "turns")

    games = json.loads(os.environ.pop("GAMES"))

    def begin_session(game: Mapping[str, Any]) -> None:
        now = replace(config, options=game["options"])
        _begin_session(player, players, progress, now, folder=folder, game=game)

    def reset() -> Any:
        os.environ.__class__ = usual_class
        if handover:
            assignment.set_environment(os.environ, _assigned(handover))
        begin_session(games[0])
        return joint.reset(1)

    question = json.loads(os.environ.pop("MATCH", "null"))
    if question and not progress.call("match", lambda: _match(adapter, question, progress)):
        return
    progress.known = {**_actions(player, config), "hears": adapter.hears}
    if not progress.call("players", lambda: who_plays(config, joint.action_spaces, group)):
        return
    players = progress.result
    names, count = progress.known["names"], progress.known["count"]
    if count is not None and names > count:
        if not player.steps_itself:
            progress.foreign = [count]
        elif isinstance(player, AgentAdapter):
            first = environments.first_number(player.env.action_space)
            progress.foreign = _foreign_actions(player.env, range(first, first + count))
    if isinstance(player, JointAdapter):
        player.views = tuple(one.name for one in players if one.human)
    game = CheckedGame(joint, players, config, progress)
    if game.load(folder, adapter.agent_module) and game.play(reset) and _talk(player, players, config, progress):
        _note_idle(joint, players, config, progress)
        if game.begin_each(games[1:], begin_session) and game.close():
            progress.over()


def _talk(
    player: AgentAdapter | JointAdapter, players: Sequence[Player], config: TrialSection, progress: AgentProgress
) -> bool:
    """Let the agent look at a line and answer it, if people talk; return False if that failed, which is reported."""
    methods = player.talk
    progress.known["talks"] = sorted(methods)
    human = next(player.name for player in players if player.human)

    def said(method: Callable[..., Any], name: str) -> None:
        result = method(progress.callbacks.session_of(name, human, None), human, LINE)
        for _ in islice(() if result is None or isinstance(result, str | bool) else result, MAX_PIECES):
            pass

    asked = [(name, methods[name]) for name in (MODERATE, REPLY) if name in methods and config.chat is not None]
    return all(progress.call(name, partial(said, method, name)) for name, method in asked)


def _ask_stand_in(section: LlmSection) -> None:
    """Let the agent reach the stand-in for the language model as it reaches the model on a server."""
    endpoint = Endpoint("", os.environ.get(variables.LLM_URL, ""))
    endpoint.play(Game(section, Ledger.of(section, ()), NoTape(), Moment))
    os.environ.update(endpoint.environment())


def _match(adapter: AgentAdapter, question: dict[str, Any], progress: AgentProgress) -> None:
    """Ask the function `match` about made-up participants. Raises AgentError, and what `match` raises."""
    function = match.function_of(adapter.agent_module)
    if function is None:
        inside = (
            "; write it beside the class Agent, not in it, and without self" if match.in_class(adapter.agent) else ""
        )
        raise AgentError(f"agent.py has no function match(waiting), and config.yml says matching: match{inside}")
    found, problem = match.groups(function, question)
    if problem:
        raise AgentError(problem)
    progress.matched = len(found)


def _reader(config: TrialSection, folder: Path, progress: AgentProgress) -> PictureReader:
    """A reader of pictures that notes which images and objects of the project cannot be drawn."""
    found = Assets() if config.scene is None else assets.load(folder, config.scene.assets)
    progress.undrawn.extend(found.problems)
    return PictureReader(config.scene, found, progress.undrawn.append)


def _handover() -> Handover | None:
    """The handover that the agent gets before the first `reset`; None if its participant is known from the start."""
    document = os.environ.pop("GIVEN", "")
    return handover.parse(document.encode()) if document else None


def _group() -> int | None:
    """The group of the participant for whom the server is started."""
    text = os.environ.get(variables.GROUP, "")
    return int(text) if text else None


def _assigned(handover: Handover) -> assignment.AssignmentDocument:
    """The document that says who plays: the handover itself, for one participant.

    If the handover names a session, its document is made up, with no members: `hippodrome check` has no stored one.
    """
    if not is_session_id(handover.user_id):
        return handover
    return SessionDocument(handover.user_id, MAX_PLAYERS, (), handover.group)


def _actions(player: AgentAdapter | JointAdapter, config: TrialSection) -> dict[str, Any]:
    """The number of actions' names, and of actions (None: not known); the names, if config.yml does not give them."""
    if isinstance(player, AgentAdapter):
        found = {
            "names": len(player.action_space),
            "count": environments.count_of(getattr(player.env, "action_space", None)),
        }
        return found | ({} if config.action_space else {"actions": player.action_space})
    counts = [count for count in player.action_counts.values() if count is not None]
    found = {"names": len(config.action_space), "count": int(max(counts)) if counts else None}
    return found | ({} if config.action_space else {"actions": max(player.action_spaces.values(), key=len)})


def _note_idle(
    joint: JointAdapter | OnePlayer,
    players: Sequence[Player],
    config: TrialSection,
    progress: AgentProgress,
) -> None:
    """Note which action the game takes without a key, and after how many steps this ends an episode, if it does soon.

    Errors are ignored: the agent has played already.
    """
    human = next(player for player in players if player.human)
    progress.known["idle"] = human.action_space[human.idle]
    idle, until = {player.name: player.idle for player in players}, time.monotonic() + NO_KEY_SECONDS
    with contextlib.suppress(Exception):
        joint.reset(1)
        for steps in range(1, int(NO_KEY_SECONDS * config.starting_frame_rate) + 1):
            if joint.step(idle).over:
                progress.known["idleEnds"] = steps
            if "idleEnds" in progress.known or time.monotonic() > until:
                break


def _begin_session(
    player: AgentAdapter | JointAdapter,
    players: Sequence[Player],
    progress: AgentProgress,
    config: TrialSection,
    *,
    folder: Path,
    game: Mapping[str, Any],
) -> None:
    """Give the agent the options of `config` and the game's answers, and call its callbacks as on a server.

    What they say, nobody hears.
    """
    humans = tuple(player.name for player in players if player.human)
    answers, names = game["answers"], tuple(player.name for player in players)
    given = answers if answers is None or len(humans) == 1 else dict.fromkeys(humans, answers)
    player.set_game(config.options, given)
    before = progress.callbacks
    progress.callbacks = callbacks = Callbacks(
        player.callbacks,
        TrialFacts("check", "check", None, names, humans, game["condition"], game["run"], given or {}),
        lambda: player.env,
        seconds=config.callback_seconds,
        stamp=dict,
        failed=progress.callback_failed,
        talk=_talk_of_agent(config, folder, humans[0]),
    )
    callbacks.first_late = before.first_late if before else None
    callbacks.session_begins()


def _talk_of_agent(config: TrialSection, folder: Path, human: str) -> TalkOfAgent:
    """What a session gives the agent for its talk: a line to answer, and the stand-in for a model."""
    line = {"by": human, "text": LINE, "episode": 1, "step": 0}
    say = None if config.chat is None else _unheard
    if config.llm is None:
        return TalkOfAgent(config.options, lambda player, n: [line], say)
    partner = Partner(config.llm, prompt_of(config.llm, folder))
    return TalkOfAgent(config.options, lambda player, n: [line], say, partner.ask)


def _unheard(text: str, to: str | Sequence[str] | None = None, by: str | None = None) -> None:
    """Take what a callback says, and do nothing."""


def _foreign_actions(env: Any, actions: range) -> list[int]:
    """Watch `env.step`: the list that is returned gets each action that is not among `actions`."""
    foreign_actions: list[int] = []
    step = env.step

    def watched(action: Any, *more: Any, **named: Any) -> Any:
        with contextlib.suppress(TypeError, ValueError):
            if int(action) not in actions:
                foreign_actions.append(int(action))
        return step(action, *more, **named)

    with contextlib.suppress(AttributeError):  # an object without a `__dict__` cannot be watched
        env.step = watched
    return foreign_actions


def _main(report: Path) -> None:
    with report.with_suffix(".stack").open("w") as stack:
        deadline = Deadline(stack, *(float(os.environ.pop(name)) for name in ("SECONDS", "CALL_SECONDS")))
        thread = threading.Thread(
            target=_try, args=[report, deadline], daemon=True
        )  # as in a server, not the main thread
        thread.start()
        thread.join()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)  # ends even if threads of the agent still run


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
