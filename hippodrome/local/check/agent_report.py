"""Makes diagnostics of the report that the process of a tried agent has written (`agent_process.py`)."""

from __future__ import annotations

import contextlib
import json
import math
import re
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hippodrome.control.config import Config, Diagnostic, agent_imports, layout, remarks
from hippodrome.control.config.diagnostics import Remark
from hippodrome.control.config.folder import read_source
from hippodrome.control.config.layout import AGENT
from hippodrome.local.check.agent_file import label_of, line_of
from hippodrome.local.check.pace import PLAY_STEPS, Pace
from hippodrome.local.check.remedies import remedy
from hippodrome.local.check.wording import short
from hippodrome.protocol import environment as variables
from hippodrome.protocol.players import HUMAN
from hippodrome.protocol.trial import TALK
from hippodrome.protocol.trial_sections import AI
from hippodrome.protocol.values import KeyPath, printable
from hippodrome.trial.agent import environments
from hippodrome.trial.agent.callback_names import REPLY
from hippodrome.trial.core.messages import FEEDBACK

SLOW = 0.5  # the share of the frame rate below which an agent gets a remark
LONG_ENOUGH = 2.0  # seconds of playing that suffice to judge the pace
ENDLESS = 120.0  # seconds of a participant's play, or PLAY_STEPS, without an end of an episode that get a remark

_SIGNATURE = re.compile(r"(\w+)\(.*\) cannot be called; write ")
_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+)')


def last_line(report: str) -> dict[str, Any]:
    """Return the last whole line of a report. Raises ValueError if there is none.

    The process may have been killed while it wrote another line.
    """
    whole, _, _ = report.rpartition("\n")
    last_line: dict[str, Any] = json.loads(whole.rpartition("\n")[2])
    return last_line


class AgentReport:
    """The report of an agent that was tried in one group. `place` is the folder that has the report."""

    def __init__(self, folder: Path, config: Config, place: Path, seconds: float, group: int | None) -> None:
        self._folder, self._config, self._place, self._seconds = folder, config, place, seconds
        self._group = group
        self._code = layout.agent_folder(folder).resolve()
        self._label = label_of(folder)
        try:
            self._report = last_line((place / "report").read_text())
        except (OSError, ValueError):
            self._report = {}

    def problems(self, status: int | None) -> list[Diagnostic]:
        """Return what is wrong with the agent.

        `status` is the exit status of the process; None if it had to be killed.
        """
        return [
            *self._early(),
            *self._failures(status),
            *self._callbacks(),
            *self._arrows(),
            *self._slow(),
            *self._slow_policies(),
            *self._forgetful(),
            *self._undrawn(),
            *self._too_large(),
            *self._only_text(),
            *self._endless(),
            *self._idle(),
            *self._turns(),
            *self._unheard(),
            *self._talk(),
            *self._nobody_matched(),
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

    def still(self) -> str:
        """Return a line that names the call that has not come back yet."""
        call = self._call()
        return f"still {call} …" if self._report.get("call") == "policies" else f"still in {call} …"

    def _where(self) -> str:
        """The place in the game, in parentheses; empty before the second step of the first group."""
        steps, episodes = self._report.get("steps", 0), self._report.get("episodes", 0)
        group = "" if self._group is None else f", group {self._group}"
        if self._report.get("call") in ("start", "match", "players", "policies", "close"):
            return f" ({group.removeprefix(', ')})" if self._group else ""
        if steps < 2 and not episodes and not self._group:
            return ""
        return f" (episode {episodes + 1}, after {steps} steps in all{group})"

    def _early(self) -> list[Diagnostic]:
        """Remarks on lines that read the participant too early; on the group only if there are groups or it failed."""
        group_counts = self._config.groups or self._report.get("error")
        unknown = variables.PARTICIPANT if group_counts else (variables.USER_ID,)
        several = self._config.project.has_sessions
        key, whose = ("players", "participants come") if several else ("warmServers", "participant comes")
        why = f"is not known here: with {key} the agent starts before its {whose}; read it in reset()"
        return [
            Diagnostic(self._name(file), line, "", f"{name} {why}", remark=True)
            for name, file, line in self._report.get("early", ())
            if name in unknown
        ]

    def _slow(self) -> list[Diagnostic]:
        """A remark on steps that take far longer than the frame rate allows, for the first group only."""
        pace = self._report.get("pace")
        if pace is None or self._group:
            return []
        message = slowness(Pace(**pace), self._config.trial.starting_frame_rate)
        return [self._in_config(("trial", "startingFrameRate"), message, remark=True)] if message else []

    def _slow_policies(self) -> list[Diagnostic]:
        """Remarks on policies that need longer for an action than they have, for the first group only."""
        trial, pace = self._config.trial, Pace(**self._report.get("pace", {}))
        diagnostics: list[Diagnostic] = []
        for player, reported in () if self._group else self._report.get("policies", {}).items():
            each = Pace(**reported)
            if trial.pace == "turns":
                policy_seconds, why = trial.policy_seconds, f"policySeconds is {trial.policy_seconds:g}"
            else:
                tick = 1 / trial.starting_frame_rate
                policy_seconds = max(tick - pace.usual, tick / 2)
                why = (
                    f"at startingFrameRate {trial.starting_frame_rate} a step has {1_000 * tick:.3g} ms, and takes "
                    f"{1_000 * pace.usual:.2g} itself"
                )
            if each.steps > 1 and each.usual > policy_seconds:
                needs = f"{self._plays(player)} needs {1_000 * each.usual:.3g} ms for an action here"
                message = f"{needs}; {why}, so its actions come late"
                diagnostics.append(self._in_config(self._player(player), message, remark=True))
        return diagnostics

    def _forgetful(self) -> list[Diagnostic]:
        """Remarks on policies that lose their state with a server, for the first group only."""
        message = (
            "has reset() but no resume(): if a server is lost, its state is lost within an episode; see "
            "docs/players.md#after-a-lost-server"
        )
        players = () if self._group else self._report.get("forgetful", ())
        return [self._in_config(self._player(name), f"{self._plays(name)} {message}", remark=True) for name in players]

    def _undrawn(self) -> list[Diagnostic]:
        """Remarks on images and objects that cannot be drawn. The game goes on without them."""
        diagnostics = []
        for sentence in self._report.get("undrawn", ()):
            if sentence.startswith("render(): "):
                diagnostics.append(self._at(self._place_of("render"), short(sentence), remark=True))
            else:
                diagnostics.append(self._in_config(("trial", "scene"), short(sentence), remark=True))
        return diagnostics

    def _too_large(self) -> list[Diagnostic]:
        """A remark on a value that is too large for the recording."""
        value = self._report.get("tooLarge")
        if value is None:
            return []
        message = (
            f"{value['name']!r} in {value['where']} is too large for the recording ({value['size']} bytes; all values "
            "of a step may have a megabyte as JSON): its size is recorded instead"
        )
        return [self._at(self._place_of("step"), message, remark=True)]

    def _only_text(self) -> list[Diagnostic]:
        """A remark on an object in a step's values of which the recording has only a text."""
        value = self._report.get("onlyText")
        if value is None or self._group:
            return []
        message = (
            f"{value['where']} has an object of the class {printable(value['type'])}, of which only str() is recorded, "
            "at most 1000 characters; return numbers, texts, arrays, lists, dicts or dataclasses"
        )
        return [self._at(self._place_of("step"), message, remark=True)]

    def _endless(self) -> list[Diagnostic]:
        """A remark on episodes that never end, for the first group only.

        With one episode and a button `stop`, participants may be meant to play as long as they like.
        """
        report, trial = self._report, self._config.trial
        steps = report.get("steps", 0)
        if not report.get("over") or report.get("episodes") or self._group or trial.most_steps < math.inf:
            return []
        if steps < min(PLAY_STEPS, ENDLESS * trial.starting_frame_rate) or (trial.max_episodes == 1 and trial.ui.stop):
            return []
        if trial.game == TALK:
            message = "the conversation has no end: write episodeSeconds, or let participants end it (ui: {stop: true})"
            return [self._in_config(("trial", "game"), message, remark=True)]
        message = (
            f"no episode ended within {steps} steps of random play; if that is not intended, step() must return "
            "terminated or truncated, or maxSteps or episodeSeconds under trial must end episodes"
        )
        return [self._at(self._place_of("step"), message, remark=True)]

    def _idle(self) -> list[Diagnostic]:
        """Remarks on what happens while no key is pressed, for the first group only."""
        config, report = self._config, self._report
        idle_action = report.get("idle")
        remark = remarks.without_a_key(config, report.get("actions", ()), idle_action)
        if idle_action is None or remark is None or self._group:
            return []
        remarks_of_idle = (
            [] if config.trial.action_space else [remark]
        )  # with names in config.yml, it is made without the agent
        steps = report.get("idleEnds")
        if steps:
            message = f"realtime, and without a key an episode ends after {steps} step{'' if steps == 1 else 's'}"
            seconds = f"{steps / config.trial.starting_frame_rate:.2g} s"
            remarks_of_idle.append(
                Remark(("trial", "pace"), f"{message} ({seconds}); write pace: turns, unless that is meant")
            )
        return [self._in_config(*remark_of_idle, remark=True) for remark_of_idle in remarks_of_idle]

    def _unheard(self) -> list[Diagnostic]:
        """A remark on controls of feedback that reach no method of the agent, for the first group only."""
        ui, source = self._config.trial.ui, read_source(self._folder)
        words = [
            word for word in ui.shown() if (word in FEEDBACK or word in ui.own) and source.names((*remarks.UI, word))
        ]
        if not words or self._group or self._label is None or self._report.get("hears", True):
            return []
        message = f"class Agent has no feedback(word), so what participants say ({words[0]}) is only recorded"
        return [self._in_config((*remarks.UI, words[0]), message, remark=True)]

    def _talk(self) -> list[Diagnostic]:
        """Remarks on methods that nobody talks to, and on names for which nobody answers, for the first group only."""
        trial, methods = self._config.trial, self._report.get("talks")
        if methods is None or self._group:
            return []
        if trial.chat is None:
            sentence = "is never called, since nobody talks; write chat: true under trial of config.yml"
            return [self._at(self._place_of(name), f"{name}() {sentence}", remark=True) for name in methods]
        alone = () if self._config.project.has_sessions else (AI,)
        names = [name for name in trial.chat.partners or alone if name not in trial.named_players()]
        if not names or REPLY in methods or trial.llm is not None:
            return []
        message = (
            f"nobody answers for {printable(names[0])}: write reply(self, session, player, text) in class Agent, or llm"
        )
        return [self._in_config(("trial", "chat"), message, remark=True)]

    def _turns(self) -> list[Diagnostic]:
        """A remark on players who take turns in real time, for the first group only."""
        config = self._config.trial
        if not self._report.get("takeTurns") or self._group or config.pace != "realtime":
            return []
        message = (
            f"realtime, but the players take turns: at {config.starting_frame_rate} steps a second, a participant who "
            "presses nothing at once takes the idle action; write pace: turns, unless that is meant"
        )
        return [self._in_config(("trial", "pace"), message, remark=True)]

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

    def _not_on_aws(self) -> list[Diagnostic]:
        """Remarks on packages that were loaded here and that servers on AWS lack."""
        if not self._config.project.may_run_on_aws:
            return []
        missing = agent_imports.missing_of_loaded(self._folder, self._config, self._report.get("loaded", ()))
        return [self._at((self._label or AGENT, None), message, remark=True) for message in missing]

    def _failures(self, status: int | None) -> list[Diagnostic]:
        """The mistake for which the agent did not play to the end; if it did, mistakes in the number of actions."""
        report, call = self._report, self._call()
        if report.get("over") or report.get("foreign"):
            return self._actions()
        error = report.get("error")
        if error is None:
            stack = self._stack()
            if stack or status is None:
                hung, player = self._hung(stack), self._asked_policy()
                message = f"{call} has not come back within {self._allowed:g} s{self._where()}"
                if report.get("call") == "match":
                    message += ": a server waits no longer, and matches nobody"
                elif report.get("within"):
                    message += ": a server waits no longer either"
                if hung is None and player is not None:
                    return [self._in_config(self._player(player), message)]
                return [self._at(hung, message)]
            return [
                self._at(
                    None, f"{call} ended Python itself ({_termination(status)}){self._where()}{self._last_words()}"
                )
            ]
        place = (self._name(error["file"]), error["line"]) if error["file"] else None
        if error["type"] in ("AgentError", "BadGroups", "FrameError", "SceneError"):
            return [self._breach(error["text"], place)]
        of_players = self._of_players(error, place)
        if of_players is not None:
            return [of_players]
        remark, game = report["call"] == "close", printable(self._config.trial.game or "Id-v0")
        message = f"{call} fails{self._where()}: {short(error['text'])}{remedy(error['type'], error['text'], game)}"
        return [self._at(place, message, remark=remark)]

    @property
    def _allowed(self) -> float:
        """The seconds that the last call had."""
        within: float = self._report.get("within") or self._seconds
        return min(self._seconds, within)

    def _of_players(self, error: Mapping[str, Any], place: tuple[str, int] | None) -> Diagnostic | None:
        """The mistake of who plays whom, or of a policy that cannot play; None for any other error."""
        text = error["text"].partition(": ")[2]
        if error["type"] == "PlayersError":
            key, _, message = text.removeprefix("trial.").partition(" ")
            return self._in_config(("trial", key), short(message))
        if error["type"] not in ("PolicyError", "PolicyFileMissing"):
            return None
        player, message = self._asked_policy(), text
        for name in self._config.trial.players_of(self._group):
            before = f"trial.players: {name} cannot be played by {self._plays(name)}: "
            if text.startswith(before):
                player, message = name, text.removeprefix(before)
        if player is None:
            return None
        if place is None or self._plays(player).endswith(".onnx"):
            return self._in_config(self._player(player), short(f"{message}{self._where()}"))
        return self._at(place, short(f"{message}{self._where()}"))

    def _asked_policy(self) -> str | None:
        """The player whose policy was called last, if one was."""
        called = re.fullmatch(r"policy (.*) (act|reset|resume)", self._report.get("call", ""))
        return called[1] if called else None

    def _callbacks(self) -> list[Diagnostic]:
        """Mistakes: callbacks that raised. A remark on a callback that took too long. Neither ends the game."""
        callbacks = self._report.get("callbacks") or {}
        found = []
        for error in callbacks.get("errors", ()):
            place = (self._name(error["file"]), error["line"]) if error["file"] else self._place_of(error["name"])
            text = f"{error['name']}() fails: {short(error['text'])}{remedy(error['type'], error['text'])}"
            found.append(self._at(place, text))
        if callbacks.get("late"):
            text = (
                f"{callbacks['late']}() takes longer than callbackSeconds ({self._config.trial.callback_seconds:g} s); "
                "callbacks are skipped until it has returned"
            )
            found.append(self._at(self._place_of(callbacks["late"]), text, remark=True))
        return found

    def _nobody_matched(self) -> list[Diagnostic]:
        """A remark on a function `match` that puts no participant into a session, for the first group only."""
        if self._group or self._report.get("matched") != 0:
            return []
        made_up = 3 * self._config.project.players
        message = f"match() made no session of {made_up} made-up participants: such participants wait on"
        return [self._at(self._place_of("match"), message, remark=True)]

    def _place_of(self, method: str) -> tuple[str, int | None]:
        return self._label or AGENT, line_of(self._code / AGENT, method)

    def _breach(self, text: str, place: tuple[str, int] | None) -> Diagnostic:
        """The mistake of an agent that does not keep the contract of docs/agent.md."""
        text = text.partition(": ")[2] or text  # without the error's own name
        if text == environments.ACTIONS_UNKNOWN:
            message = "missing; list the game's actions, since the environment does not name them"
            return self._in_config(("trial", "actionSpace"), message)
        text = text.replace(str(self._code / AGENT), AGENT).replace(f" in {AGENT}", "")
        if text.startswith(f"{AGENT} has no"):
            return self._at(None, text.replace(f"{AGENT} has", "there is", 1))
        if self._config.project.has_sessions and "observations by player" in text:
            text += "; an environment with one player is for participants who play alone (project.players: 1)"
        method = _SIGNATURE.match(text)  # the error is about the method that its text names, whichever was called
        if method:
            return self._at((self._label or AGENT, line_of(self._code / AGENT, method[1])), short(text))
        return self._at(place, short(text), whole="has no" in text)

    def _actions(self) -> list[Diagnostic]:
        """Mistakes and remarks on an actionSpace with more or fewer names than the environment has actions."""
        names, count = self._report.get("names"), self._report.get("count")
        if not self._config.trial.action_space or count is None or names == count:
            return []
        if names > count and not self._report.get("foreign"):
            return []  # step() in agent.py translates the numbers
        message = f"has {names} names, but the environment has {count} actions"
        if names > count:
            message += "; take out the names of actions that it does not have, or let step() in agent.py translate them"
        return [self._in_config(("trial", "actionSpace"), message, remark=names < count)]

    def _arrows(self) -> list[Diagnostic]:
        """Remarks on arrows of `ui` and keys that do nothing; none if the names of the actions are not known."""
        names, source = self._report.get("actions", ()), read_source(self._folder)
        if not names:
            return []
        if names == [str(index) for index in range(len(names))]:
            found = remarks.arrows_of_unnamed_actions(self._config, len(names))
        else:
            found = remarks.arrows_without_an_action(self._config, names)
        arrows = [arrow for arrow in found if source.names(arrow.path)]
        keys = [] if self._config.trial.action_space else remarks.keys_without_an_action(self._config, names)
        return [self._in_config(*arrow, remark=True) for arrow in (*arrows, *keys)]

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
        settings = [f"{what} {json.dumps(value, ensure_ascii=False)}" for what, value in self._game().items() if value]
        return f"{names}, with the {' and the '.join(settings)}," if settings else names

    def _game(self) -> Mapping[str, Any]:
        """The options and answers with which an episode of another game or level was begun."""
        game: Mapping[str, Any] = self._report.get("game", {})
        return game

    def _at(
        self, place: tuple[str, int | None] | None, message: str, *, remark: bool = False, whole: bool = False
    ) -> Diagnostic:
        """The problem at `place`; without one, at the method that was called last, or with `whole` at the class."""
        if self._label is None:
            return self._in_config(("trial", "game"), message, remark=remark)
        file, line = place or (
            self._label,
            line_of(self._code / AGENT, "" if whole else self._report.get("call", "start")),
        )
        return Diagnostic(file, line, "", message, remark)

    def _in_config(self, path: KeyPath, message: str, remark: bool = False) -> Diagnostic:
        return read_source(self._folder).diagnostic(path, message, remark=remark)

    def _stack(self) -> str:
        """The stacks of all threads when the time was over; empty if the process ended before."""
        try:
            return (self._place / "report.stack").read_text(errors="replace")
        except OSError:
            return ""

    def _hung(self, stack: str) -> tuple[str, int] | None:
        """The file and line of the project's code in these stacks; None if it did not run."""
        frames = [(Path(frame_match["file"]), int(frame_match["line"])) for frame_match in _FRAME.finditer(stack)]
        ours = [(self._name(file.name), line) for file, line in frames if file.parent == self._code]
        return ours[0] if ours else None

    def _name(self, file: str) -> str:
        """The path of a file beside agent.py, as messages name it."""
        return (Path(self._label or AGENT).parent / file).as_posix()

    def _last_words(self) -> str:
        """The last line that the process printed, after a colon; empty if it printed nothing."""
        lines = (self._place / "output").read_text(errors="replace").split("\n")
        printed = [line.strip() for line in lines if line.strip()]
        return f": {short(printed[-1])}" if printed else ""


def slowness(pace: Pace, rate: int) -> str | None:
    """Return the remark on an agent that is far slower than the frame rate; None if it is not.

    `rate` is in steps a second.
    """
    seconds = pace.seconds - pace.slowest
    if seconds < LONG_ENOUGH or (pace.steps - 1) / seconds >= SLOW * rate:
        return None
    return f"it plays {(pace.steps - 1) / seconds:.2g} steps a second here; startingFrameRate is {rate}"


def _termination(status: int) -> str:
    if status < 0:
        with contextlib.suppress(ValueError):
            return f"signal {signal.Signals(-status).name}"
    return f"exit status {status}"
