"""`python -m hippodrome.local.check.agent_process REPORT`: lets the agent play, and writes to REPORT how far it got.

Runs in a process of its own, since the agent may hang or end Python. `agent.py` starts it with the variables of a trial
server, and with `SETTINGS`; `agent_report.py` reads the report.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar

from hippodrome.local.check.agent_progress import AgentProgress
from hippodrome.local.check.game import CheckedGame, OnePlayer
from hippodrome.local.check.wording import short
from hippodrome.protocol import environment as variables
from hippodrome.protocol import handover
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.session import MAX_PLAYERS, SessionDocument, is_session_id
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.trial_llm import LlmSection
from hippodrome.protocol.trial_sections import AI
from hippodrome.protocol.values import printable
from hippodrome.trial.agent import environments, match
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.callbacks import Callbacks, TrialFacts
from hippodrome.trial.agent.joint import JointAdapter, start
from hippodrome.trial.agent.loading import AgentError
from hippodrome.trial.agent.replies import TalkOfAgent
from hippodrome.trial.agent.signatures import MODERATE, REPLY
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


@dataclass
class _Try:
    """One try of the agent. `owner` says who plays, if that becomes known only at the first `reset`."""

    folder: Path
    config: TrialSection
    progress: AgentProgress
    settings: Mapping[str, Any]
    owner: Handover | None
    agent: AgentAdapter
    player: AgentAdapter | JointAdapter = field(init=False)
    players: Sequence[Player] = field(init=False)

    def run(self, group: int | None) -> None:
        """Let the agent play. The first call that fails is the last one."""
        config, progress, agent = self.config, self.progress, self.agent
        usual_class, _EarlyEnviron.folder = os.environ.__class__, self.folder
        if self.owner:
            os.environ.__class__ = _EarlyEnviron
        if not progress.call("start", lambda: start(agent, tuple(config.players_of(group)))):
            return
        self.player = player = progress.result
        joint = player if isinstance(player, JointAdapter) else OnePlayer(player, masked=config.pace == "turns")
        question, games = self.settings["match"], self.settings["games"]
        if question and not progress.call("match", lambda: _match(agent, question, progress)):
            return
        progress.facts |= {**_actions(player, config), "hears": agent.hears}
        if progress.facts["count"] is not None and progress.facts["names"] > progress.facts["count"]:
            progress.facts["foreign"] = _foreign_actions(player, progress.facts["count"])
        if not progress.call("players", lambda: who_plays(config, joint.action_spaces, group)):
            return
        self.players = progress.result
        if isinstance(player, JointAdapter):
            player.views = tuple(one.name for one in self.players if one.human)

        def reset() -> Any:
            os.environ.__class__ = usual_class
            if self.owner:
                assignment.set_environment(os.environ, _assigned(self.owner))
            self._begin_session(games[0])
            return joint.reset(1)

        game = CheckedGame(joint, self.players, config, progress)
        if (
            game.load(self.folder, agent.agent_module)
            and game.play(reset)
            and self._talk()
            and game.begin_each(games[1:], self._begin_session)
            and game.close()
        ):
            progress.over()

    def _begin_session(self, game: Mapping[str, Any]) -> None:
        """Give the agent a game's options and answers, and call its callbacks as on a server.

        What they say, nobody hears.
        """
        config, progress, player = replace(self.config, options=game["options"]), self.progress, self.player
        names = tuple(player.name for player in self.players)
        humans = tuple(player.name for player in self.players if player.human)
        answers = game["answers"]
        given = answers if answers is None or len(humans) == 1 else dict.fromkeys(humans, answers)
        player.set_game(config.options, given)
        before, line = progress.callbacks, {"by": humans[0], "text": LINE, "episode": 1, "step": 0}
        talk = TalkOfAgent(
            config.options,
            lambda player, n: [line],
            None if config.chat is None else lambda text, to=None, by=None: None,
            *(() if config.llm is None else (Partner(config.llm, prompt_of(config.llm, self.folder)).ask,)),
        )
        progress.callbacks = Callbacks(
            player.callbacks,
            TrialFacts("check", "check", None, names, humans, game["condition"], game["run"], given or {}),
            lambda: player.env,
            seconds=config.callback_seconds,
            stamp=dict,
            failed=progress.callback_failed,
            talk=talk,
        )
        progress.callbacks.first_late = before.first_late if before else None
        progress.callbacks.session_begins()

    def _talk(self) -> bool:
        """Let the agent look at a line and answer it, if people talk; return False if that failed, which is reported.

        Remark on methods that nobody talks to, and on a name for which nobody answers.
        """
        progress, methods, chat = self.progress, self.player.talk, self.config.chat
        human = next(player.name for player in self.players if player.human)
        if chat is None:
            sentence = "is never called, since nobody talks; write chat: true under trial of config.yml"
            for name in sorted(methods):
                progress.problem(name, f"{name}() {sentence}")
            return True
        several = self.owner is not None and is_session_id(self.owner.user_id)
        partners = chat.partners or (() if several else (AI,))
        names = [name for name in partners if name not in self.config.named_players()]
        if names and REPLY not in methods and self.config.llm is None:
            sentence = "write reply(self, session, player, text) in class Agent, or llm"
            progress.problem(("trial", "chat"), f"nobody answers for {printable(names[0])}: {sentence}")

        def said(method: Callable[..., Any], name: str) -> None:
            result = method(progress.callbacks.session_of(name, human, None), human, LINE)
            for _ in islice(() if result is None or isinstance(result, str | bool) else result, MAX_PIECES):
                pass

        asked = [name for name in (MODERATE, REPLY) if name in methods]
        return all(progress.call(name, partial(said, methods[name], name)) for name in asked)


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
    groups, problem = match.groups(function, question)
    if problem:
        raise AgentError(problem)
    if not groups:
        made_up = len(question["waiting"])
        message = f"match() made no session of {made_up} made-up participants: such participants wait on"
        progress.problem("match", message)


def _reader(config: TrialSection, folder: Path, progress: AgentProgress) -> PictureReader:
    """A reader of pictures that remarks on the images and objects of the project that cannot be drawn."""

    def undrawn(sentence: str) -> None:
        progress.problem("render" if sentence.startswith("render(): ") else ("trial", "scene"), short(sentence))

    scene_assets = Assets() if config.scene is None else assets.load(folder, config.scene.assets)
    for sentence in scene_assets.problems:
        undrawn(sentence)
    return PictureReader(config.scene, scene_assets, undrawn)


def _assigned(owner: Handover) -> assignment.AssignmentDocument:
    """The document that says who plays: the handover itself, for one participant.

    If the handover names a session, its document is made up, with no members: `hippodrome check` has no stored one.
    """
    if not is_session_id(owner.user_id):
        return owner
    return SessionDocument(owner.user_id, MAX_PLAYERS, (), owner.group)


def _actions(player: AgentAdapter | JointAdapter, config: TrialSection) -> dict[str, Any]:
    """The number of actions' names, and of actions (None: not known); the names, if config.yml does not give them."""
    if isinstance(player, AgentAdapter):
        count = environments.count_of(getattr(player.env, "action_space", None))
        names = player.action_space
    else:
        counts = [count for count in player.action_counts.values() if count is not None]
        count = int(max(counts)) if counts else None
        names = config.action_space or max(player.action_spaces.values(), key=len)
    facts = {"names": len(names), "count": count}
    return facts | ({} if config.action_space else {"actions": names})


def _foreign_actions(player: AgentAdapter | JointAdapter, count: int) -> list[int]:
    """Watch an environment with `count` actions: the list that is returned gets each other action that it is given."""
    if not player.steps_itself:
        return [count]
    foreign_actions: list[int] = []
    if isinstance(player, AgentAdapter):
        env, first = player.env, environments.first_number(player.env.action_space)
        step = env.step

        def watched(action: Any, *more: Any, **named: Any) -> Any:
            with contextlib.suppress(TypeError, ValueError):
                if int(action) not in range(first, first + count):
                    foreign_actions.append(int(action))
            return step(action, *more, **named)

        with contextlib.suppress(AttributeError):  # an object without a `__dict__` cannot be watched
            env.step = watched
    return foreign_actions


def _main(report: Path) -> None:
    settings = json.loads(os.environ.pop("SETTINGS"))
    folder, group_text = Path(os.environ[variables.AGENT_DIR]), os.environ.get(variables.GROUP, "")
    config = trial_section(json.loads(os.environ[variables.TRIAL]))
    progress = AgentProgress(report, folder, settings, _EarlyEnviron.lines)
    if config.llm is not None:
        _ask_stand_in(config.llm)
    owner = handover.parse(settings["owner"].encode()) if settings["owner"] else None
    group = owner.group if owner else int(group_text) if group_text else None
    adapter = AgentAdapter(folder, config.game, config.action_space, _reader(config, folder, progress))
    tried = _Try(folder, config, progress, settings, owner, adapter)
    thread = threading.Thread(target=tried.run, args=[group], daemon=True)  # as in a server, not the main thread
    thread.start()
    thread.join()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(0)  # ends even if threads of the agent still run


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
