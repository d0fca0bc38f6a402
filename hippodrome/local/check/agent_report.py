"""Makes diagnostics of the report that the process of a tried agent has written (`agent_progress.py`)."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hippodrome.control.config import Config, Diagnostic, agent_imports, layout, remarks
from hippodrome.control.config.folder import read_source
from hippodrome.control.config.layout import AGENT
from hippodrome.local.check.agent_file import label_of, line_of
from hippodrome.local.check.remedies import remedy
from hippodrome.local.check.wording import short
from hippodrome.protocol import environment as variables
from hippodrome.protocol.players import HUMAN
from hippodrome.protocol.trial import TALK
from hippodrome.protocol.values import KeyPath, printable
from hippodrome.trial.agent import environments
from hippodrome.trial.core.messages import FEEDBACK

PLAY_STEPS = 5_000
"""The most steps that are played in each group."""

_SIGNATURE = re.compile(r"(\w+)\(.*\) cannot be called; write ")
_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+)')


class AgentReport:
    """The report of an agent that was tried in one group. `place` is the folder that has the report."""

    def __init__(self, folder: Path, config: Config, place: Path, seconds: float, group: int | None) -> None:
        self._config, self._place, self._seconds, self._group = config, place, seconds, group
        self._folder, self._source = folder, read_source(folder)
        self._code = layout.agent_folder(folder).resolve()
        self._label = label_of(folder)
        self._report: dict[str, Any] = {}
        with contextlib.suppress(OSError, ValueError):
            self._report = json.loads((place / "report").read_bytes().partition(b"\n")[0])

    def problems(self, status: int | None) -> list[Diagnostic]:
        """Return what is wrong with the agent.

        `status` is the exit status of the process; None if it had to be killed.
        """
        report = self._report
        return [
            *self._early(),
            *(
                self._at(problem["place"], problem["message"], problem["remark"])
                for problem in report.get("problems", ())
            ),
            *self._late(),
            *(self._actions() if report.get("over") or report.get("foreign") else [self._failure(status)]),
            *self._arrows(),
            *self._forgetful(),
            *self._endless(),
            *self._unheard(),
            *self._not_on_aws(),
        ]

    @property
    def played(self) -> bool:
        """Whether the agent has taken a step."""
        return bool(self._report.get("steps"))

    def how_far(self) -> str:
        """Return one line that says how far the agent played."""
        report = self._report
        where = "" if self._group is None else f" in group {self._group}"
        episodes, steps, most = report.get("episodes", 0), report.get("steps", 0), self._config.trial.max_episodes
        rest = "" if not report.get("over") or episodes >= most else " (its time was over)"
        return f"played{where}: {episodes} of {most} episodes to the end, {steps} steps{rest}"

    # What keeps the agent from playing

    def _failure(self, status: int | None) -> Diagnostic:
        """The mistake for which the agent did not play to the end."""
        report, call, error = self._report, self._call(), self._report.get("error")
        if error is None:
            return self._ended(status)
        place = (self._name(error["file"]), error["line"]) if error["file"] else None
        if error["type"] in ("AgentError", "BadGroups", "FrameError", "SceneError"):
            return self._breach(error["text"], place)
        game = printable(self._config.trial.game or "Id-v0")
        message = f"{call} fails{self._where()}: {short(error['text'])}{remedy(error['type'], error['text'], game)}"
        return self._of_players(error, place) or self._at(place, message, remark=report["call"] == "close")

    def _ended(self, status: int | None) -> Diagnostic:
        """The mistake of an agent that has not come back in time, or that has ended Python."""
        report, call, stack = self._report, self._call(), ""
        with contextlib.suppress(OSError):
            stack = (self._place / "report.stack").read_text(errors="replace")
        if not stack and status is not None:
            return self._at(
                None, f"{call} ended Python itself ({_termination(status)}){self._where()}{self._last_words()}"
            )
        frames = [(Path(frame["file"]), int(frame["line"])) for frame in _FRAME.finditer(stack)]
        hung = next(((self._name(file.name), line) for file, line in frames if file.parent == self._code), None)
        allowed = min(self._seconds, report.get("within") or self._seconds)
        message = f"{call} has not come back within {allowed:g} s{self._where()}"
        if report.get("call") == "match":
            message += ": a server waits no longer, and matches nobody"
        elif report.get("within"):
            message += ": a server waits no longer either"
        player = self._asked_policy()
        return self._at(self._player(player) if hung is None and player is not None else hung, message)

    def _of_players(
        self, error: Mapping[str, Any], place: str | list[Any] | tuple[Any, ...] | None
    ) -> Diagnostic | None:
        """The mistake of who plays whom, or of a policy that cannot play; None for any other error."""
        text = error["text"].partition(": ")[2]
        if error["type"] == "PlayersError":
            key, _, message = text.removeprefix("trial.").partition(" ")
            return self._at(("trial", key), short(message))
        if error["type"] not in ("PolicyError", "PolicyFileMissing"):
            return None
        player, message = self._asked_policy(), text
        for name in self._config.trial.players_of(self._group):
            before = f"trial.players: {name} cannot be played by {self._plays(name)}: "
            if text.startswith(before):
                player, message = name, text.removeprefix(before)
        if player is None:
            return None
        in_config = place is None or self._plays(player).endswith(".onnx")
        return self._at(self._player(player) if in_config else place, short(f"{message}{self._where()}"))

    def _breach(self, text: str, place: str | list[Any] | tuple[Any, ...] | None) -> Diagnostic:
        """The mistake of an agent that does not keep the contract of docs/agent.md."""
        text = text.partition(": ")[2] or text  # without the error's own name
        if text == environments.ACTIONS_UNKNOWN:
            message = "missing; list the game's actions, since the environment does not name them"
            return self._at(("trial", "actionSpace"), message)
        text = text.replace(str(self._code / AGENT), AGENT).replace(f" in {AGENT}", "")
        if text.startswith(f"{AGENT} has no"):
            return self._at(None, text.replace(f"{AGENT} has", "there is", 1))
        if self._config.project.has_sessions and "observations by player" in text:
            text += "; an environment with one player is for participants who play alone (project.players: 1)"
        method = _SIGNATURE.match(text)  # the error is about the method that its text names, whichever was called
        if method:
            return self._at(method[1], short(text))
        return self._at(place or ("" if "has no" in text else None), short(text))

    # What the study would not want

    def _early(self) -> Iterator[Diagnostic]:
        """Remarks on lines that read the participant too early; on the group only if there are groups or it failed."""
        group_counts = self._config.groups or self._report.get("error")
        unknown = variables.PARTICIPANT if group_counts else (variables.USER_ID,)
        several = self._config.project.has_sessions
        key, whose = ("players", "participants come") if several else ("warmServers", "participant comes")
        why = f"is not known here: with {key} the agent starts before its {whose}; read it in reset()"
        for name, file, line in self._report.get("early", ()):
            if name in unknown:
                yield self._at((self._name(file), line), f"{name} {why}", remark=True)

    def _late(self) -> Iterator[Diagnostic]:
        """A remark on a callback that took too long."""
        name, seconds = self._report.get("late"), self._config.trial.callback_seconds
        if name:
            late = f"{name}() takes longer than callbackSeconds ({seconds:g} s)"
            yield self._at(name, f"{late}; callbacks are skipped until it has returned", remark=True)

    def _actions(self) -> list[Diagnostic]:
        """A mistake or remark on an actionSpace with more or fewer names than the environment has actions."""
        names, count, path = self._report.get("names"), self._report.get("count"), ("trial", "actionSpace")
        if not self._config.trial.action_space or count is None or names == count:
            return []
        message = f"has {names} names, but the environment has {count} actions"
        if names < count:
            return [self._at(path, message, remark=True)]
        advice = "take out the names of actions that it does not have, or let step() in agent.py translate them"
        return [self._at(path, f"{message}; {advice}")] if self._report.get("foreign") else []

    def _arrows(self) -> list[Diagnostic]:
        """Remarks on arrows of `ui` and keys that do nothing; none if the names of the actions are not known."""
        names = self._report.get("actions", ())
        if not names:
            return []
        if names == [str(index) for index in range(len(names))]:
            found = remarks.arrows_of_unnamed_actions(self._config, len(names))
        else:
            found = remarks.arrows_without_an_action(self._config, names)
        arrows = [arrow for arrow in found if self._source.names(arrow.path)]
        keys = [] if self._config.trial.action_space else remarks.keys_without_an_action(self._config, names)
        return [self._at(path, message, remark=True) for path, message in (*arrows, *keys)]

    def _forgetful(self) -> Iterator[Diagnostic]:
        """Remarks on policies that lose their state with a server."""
        message = (
            "has reset() but no resume(): if a server is lost, its state is lost within an episode; see "
            "docs/players.md#after-a-lost-server"
        )
        for name in self._report.get("forgetful", ()):
            yield self._at(self._player(name), f"{self._plays(name)} {message}", remark=True)

    def _endless(self) -> Iterator[Diagnostic]:
        """A remark on episodes that never end, in which participants would stay.

        With one episode and a button `stop`, participants may be meant to play as long as they like.
        """
        report, trial = self._report, self._config.trial
        endless = trial.most_steps == math.inf and not (trial.max_episodes == 1 and trial.ui.stop)
        if endless and trial.game == TALK:
            message = "the conversation has no end: write episodeSeconds, or let participants end it (ui: {stop: true})"
            yield self._at(("trial", "game"), message, remark=True)
        elif endless and report.get("over") and not report.get("episodes") and report.get("steps", 0) >= PLAY_STEPS:
            message = (
                f"no episode ended within {report['steps']} steps of random play; if that is not intended, step() must "
                "return terminated or truncated, or maxSteps or episodeSeconds under trial must end episodes"
            )
            yield self._at("step", message, remark=True)

    def _unheard(self) -> Iterator[Diagnostic]:
        """A remark on controls of feedback that reach no method of the agent."""
        ui = self._config.trial.ui
        words = [
            word
            for word in ui.shown()
            if (word in FEEDBACK or word in ui.own) and self._source.names((*remarks.UI, word))
        ]
        if words and self._label is not None and not self._report.get("hears", True):
            message = f"class Agent has no feedback(word), so what participants say ({words[0]}) is only recorded"
            yield self._at((*remarks.UI, words[0]), message, remark=True)

    def _not_on_aws(self) -> Iterator[Diagnostic]:
        """Remarks on packages that were loaded here and that servers on AWS lack."""
        if self._config.project.may_run_on_aws:
            for message in agent_imports.missing_of_loaded(self._folder, self._config, self._report.get("loaded", ())):
                yield self._at((self._label or AGENT, None), message, remark=True)

    # Words and places

    def _call(self) -> str:
        """The last call, as messages name it."""
        call = self._report.get("call", "start")
        policy = self._asked_policy()
        if policy is not None:
            return f"{call.rpartition(' ')[2]}() of {printable(self._plays(policy))}"
        names = {
            "policies": "making the policies",
            "start": f'start("{printable(self._config.trial.game or "")}")',
            "step": f"step({self._report.get('action', 0)})",
        }.get(call, f"{call}()")
        game = self._report.get("game", {})  # of another game or level with which an episode was begun
        settings = [f"{what} {json.dumps(value, ensure_ascii=False)}" for what, value in game.items() if value]
        return f"{names}, with the {' and the '.join(settings)}," if settings else names

    def _where(self) -> str:
        """The place in the game, in parentheses; empty before the second step of the first group."""
        steps, episodes = self._report.get("steps", 0), self._report.get("episodes", 0)
        group = f"group {self._group}" if self._group else ""
        if self._report.get("call") in ("start", "match", "players", "policies", "close"):
            return f" ({group})" if group else ""
        if steps < 2 and not episodes and not group:
            return ""
        return f" (episode {episodes + 1}, after {steps} steps in all{f', {group}' if group else ''})"

    def _asked_policy(self) -> str | None:
        """The player whose policy was called last, if one was."""
        called = re.fullmatch(r"policy (.*) (act|reset|resume)", self._report.get("call", ""))
        return called[1] if called else None

    def _plays(self, player: str) -> str:
        """What plays this player, as config.yml says it; for a human, the policy that substitutes for them, if any."""
        trial = self._config.trial
        plays, substitute = trial.players_of(self._group).get(player, player), trial.substitute
        return substitute if plays == HUMAN and substitute else plays

    def _player(self, player: str) -> KeyPath:
        """The key of config.yml that says who plays this player, or who substitutes for the human."""
        if self._config.trial.players_of(self._group).get(player) == HUMAN:
            return ("trial", "substitute")
        by_group = (str(self._group or 0),) if self._config.trial.groups() else ()
        return ("trial", "players", *by_group, player)

    def _at(self, place: str | list[Any] | tuple[Any, ...] | None, message: str, remark: bool = False) -> Diagnostic:
        """The problem at `place`; without one, at the method that was called last. The method "" is the whole class."""
        if place is None or isinstance(place, str):
            method = self._report.get("call", "start") if place is None else place
            file, line = self._label or AGENT, line_of(self._code / AGENT, method)
        elif place[0] == "trial":
            return self._source.diagnostic(tuple(place), message, remark=remark)
        else:
            file, line = place
        if self._label is None:
            return self._source.diagnostic(("trial", "game"), message, remark=remark)
        return Diagnostic(file, line, "", message, remark)

    def _name(self, file: str) -> str:
        """The path of a file beside agent.py, as messages name it."""
        return (Path(self._label or AGENT).parent / file).as_posix()

    def _last_words(self) -> str:
        """The last line that the process printed, after a colon; empty if it printed nothing."""
        lines = (self._place / "output").read_text(errors="replace").split("\n")
        printed = [line.strip() for line in lines if line.strip()]
        return f": {short(printed[-1])}" if printed else ""


def _termination(status: int) -> str:
    if status < 0:
        with contextlib.suppress(ValueError):
            return f"signal {signal.Signals(-status).name}"
    return f"exit status {status}"
