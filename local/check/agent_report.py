"""What `make check` says of an agent that was tried: the report of its process (`agent_process.py`) as diagnostics."""

from __future__ import annotations

import contextlib
import json
import re
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hippodrome.config import Config, Diagnostic, agent_imports, layout, remarks
from hippodrome.config.diagnostics import Keys, printable
from hippodrome.config.folder import read_source
from hippodrome.config.layout import AGENT
from local.check.agent_file import label_of, line_of
from local.check.pace import Pace
from local.check.remedies import remedy
from local.check.wording import short
from protocol import environment as variables
from protocol.players import HUMAN

SLOW = 0.5  # of the frame rate; slower than that is remarked
LONG_ENOUGH = 2.0  # seconds of playing from which the pace can be told

_SIGNATURE = re.compile(r"(\w+)\(.*\) cannot be called; write ")
_FRAME = re.compile(r'File "(?P<file>[^"]+)", line (?P<line>\d+)')


def last_line(report: str) -> dict[str, Any]:
    """What the agent's process knew last. It may have been killed while it wrote a further line. Raises ValueError."""
    whole, _, _ = report.rpartition("\n")
    found: dict[str, Any] = json.loads(whole.rpartition("\n")[2])
    return found


class AgentReport:
    """Says what the agent's process has reported."""

    def __init__(self, folder: Path, config: Config, place: Path, seconds: float, group: int | None = None) -> None:
        self._folder, self._config, self._place, self._seconds = folder, config, place, seconds
        self._group = group
        self._code = layout.agent_folder(folder).resolve()
        self._label = label_of(folder)
        try:
            self._report = last_line((place / "report").read_text())
        except (OSError, ValueError):
            self._report = {}

    def problems(self, status: int | None) -> list[Diagnostic]:
        """What to say of the report, if the process has ended with this exit status (None: it had to be killed)."""
        return [
            *self._early(),
            *self._failures(status),
            *self._callbacks(),
            *self._arrows(),
            *self._slow(),
            *self._slow_policies(),
            *self._undrawn(),
            *self._outside(),
            *self._too_large(),
            *self._idle(),
            *self._turns(),
            *self._nobody_matched(),
            *self._not_on_aws(),
        ]

    @property
    def played(self) -> bool:
        """Whether there was a step at all."""
        return bool(self._report.get("steps"))

    def how_far(self) -> str:
        """What was played, in a line."""
        report = self._report
        where = "" if self._group is None else f" in group {self._group}"
        episodes, steps, most = report.get("episodes", 0), report.get("steps", 0), self._config.trial.max_episodes
        rest = "" if not report.get("over") or episodes >= most else " (its time was over)"
        return f"played{where}: {episodes} of {most} episodes to the end, {steps} steps{rest}"

    def _where(self) -> str:
        """In which step of which episode it was; nothing for the first step in all groups."""
        steps, episodes = self._report.get("steps", 0), self._report.get("episodes", 0)
        group = "" if self._group is None else f", group {self._group}"
        if self._report.get("call") in ("start", "match", "players", "policies", "close"):
            return f" ({group.removeprefix(', ')})" if self._group else ""
        if steps < 2 and not episodes and not self._group:
            return ""
        return f" (episode {episodes + 1}, after {steps} steps in all{group})"

    def _early(self) -> list[Diagnostic]:
        """Where the agent asked for what is not known yet. A group matters where there are some, or if it failed."""
        group_matters = self._config.groups or self._report.get("error")
        matters = variables.PARTICIPANT if group_matters else (variables.USER_ID,)
        several = self._config.project.has_sessions
        key, whose = ("players", "participants come") if several else ("warmServers", "participant comes")
        why = f"is not known here: with {key} the agent starts before its {whose}; read it in reset()"
        asked = self._report.get("early", ())
        return [
            Diagnostic(self._name(file), line, "", f"{name} {why}", remark=True)
            for name, file, line in asked
            if name in matters
        ]

    def _slow(self) -> list[Diagnostic]:
        """A step that takes far longer than the frame rate allows. Told once, of the first group."""
        pace = self._report.get("pace")
        if pace is None or self._group:
            return []
        said = slowness(Pace(**pace), self._config.trial.starting_frame_rate)
        return [self._in_config(("trial", "startingFrameRate"), said, remark=True)] if said else []

    def _slow_policies(self) -> list[Diagnostic]:
        """Policies that need longer for an action than there is time. Told once, of the first group."""
        trial, pace = self._config.trial, Pace(**self._report.get("pace", {}))
        found: list[Diagnostic] = []
        for player, told in () if self._group else self._report.get("policies", {}).items():
            each = Pace(**told)
            if trial.pace == "turns":
                given, why = trial.policy_seconds, f"policySeconds is {trial.policy_seconds:g}"
            else:
                tick = 1 / trial.starting_frame_rate
                given = max(tick - pace.usual, tick / 2)
                why = (
                    f"at startingFrameRate {trial.starting_frame_rate} a step has {1_000 * tick:.3g} ms, and takes "
                    f"{1_000 * pace.usual:.2g} itself"
                )
            if each.steps > 1 and each.usual > given:
                needs = f"{self._plays(player)} needs {1_000 * each.usual:.3g} ms for an action here"
                message = f"{needs}; {why}, so its actions come late"
                found.append(self._in_config(self._player(player), message, remark=True))
        return found

    def _undrawn(self) -> list[Diagnostic]:
        """What in images and objects cannot be drawn. The game goes on without it."""
        found = []
        for sentence in self._report.get("undrawn", ()):
            if sentence.startswith("render(): "):
                found.append(self._at(self._place_of("render"), short(sentence), remark=True))
            else:
                found.append(self._in_config(("trial", "scene"), short(sentence), remark=True))
        return found

    def _outside(self) -> list[Diagnostic]:
        """Objects that are never in the picture, since their places are pixels. Told once, of the first ones."""
        told = {} if self._group else self._report.get("outside", {})
        if not told:
            return []
        name, (x, y) = next(iter(told.items()))
        others = {1: "", 2: ", nor is 1 other"}.get(len(told), f", nor are {len(told) - 1} others")
        message = (
            f"render(): the object {name!r} is never in the picture{others}: its place is ({x:g}, {y:g}), and 1 is the "
            "picture's right or lower edge; did you mean pixels? Write coordinates: pixels into trial.scene"
        )
        return [self._at(self._place_of("render"), message, remark=True)]

    def _too_large(self) -> list[Diagnostic]:
        """A value that the recording does not hold."""
        told = self._report.get("tooLarge")
        if told is None:
            return []
        message = (
            f"{told['name']!r} in {told['where']} is too large for the recording ({told['size']} bytes; all values of "
            "a step may have a megabyte as JSON): its size is recorded instead"
        )
        return [self._at(self._place_of("step"), message, remark=True)]

    def _idle(self) -> list[Diagnostic]:
        """An action of no key that visibly does something. Told once, of the first group."""
        told = self._report.get("idle")
        if told is None or self._group or told["action"] in remarks.IDLE:
            return []
        still = ", ".join(told["still"])
        advice = (
            f'write idleAction: "{told["still"][0]}"'
            if still
            else "name one as idleAction, or see docs/agent.md#no-key"
        )
        said = f"; {still} {'does' if len(told['still']) == 1 else 'do'} not" if still else ""
        message = (
            f'missing; while no key is pressed, the game takes its action "{told["action"]}", which changes the picture'
            f"{said}: {advice}"
        )
        return [self._in_config(("trial", "idleAction"), message, remark=True)]

    def _turns(self) -> list[Diagnostic]:
        """Players who take turns in real time. Told once, of the first group."""
        config = self._config.trial
        if not self._report.get("takeTurns") or self._group or config.pace != "realtime":
            return []
        message = (
            f"realtime, but the players take turns: at {config.starting_frame_rate} steps a second, a participant who "
            "presses nothing at once takes the idle action; write pace: turns, unless that is meant"
        )
        return [self._in_config(("trial", "pace"), message, remark=True)]

    def _plays(self, player: str) -> str:
        """What plays this player, as config.yml has it: a policy in the place of a human too."""
        trial = self._config.trial
        plays, substitute = trial.players_of(self._group).get(player, player), trial.substitute
        return substitute if plays == HUMAN and substitute else plays

    def _player(self, player: str) -> Keys:
        """Where config.yml says who plays this player, or in their place."""
        if self._config.trial.players_of(self._group).get(player) == HUMAN:
            return ("trial", "substitute")
        by_group = (str(self._group or 0),) if self._config.trial.groups() else ()
        return ("trial", "players", *by_group, player)

    def _not_on_aws(self) -> list[Diagnostic]:
        """What was loaded here, and participants' servers lack."""
        if not agent_imports.may_run_on_aws(self._config):
            return []
        found = agent_imports.loaded(self._folder, self._config, self._report.get("loaded", ()))
        return [self._at((self._label or AGENT, None), message, remark=True) for message in found]

    def _failures(self, status: int | None) -> list[Diagnostic]:
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
        told = self._of_players(error, place)
        if told is not None:
            return [told]
        remark = report["call"] == "close"
        message = f"{call} fails{self._where()}: {short(error['text'])}{remedy(error['type'], error['text'])}"
        return [self._at(place, message, remark=remark)]

    @property
    def _allowed(self) -> float:
        """Seconds that the last call had."""
        within: float = self._report.get("within", self._seconds)
        return min(self._seconds, within)

    def _of_players(self, error: Mapping[str, Any], place: tuple[str, int] | None) -> Diagnostic | None:
        """What to say of who plays whom, and of a policy that cannot play; None if it is another error."""
        text = error["text"].partition(": ")[2]
        if error["type"] == "PlayersError":
            key, _, said = text.removeprefix("trial.").partition(" ")
            return self._in_config(("trial", key), short(said))
        if error["type"] not in ("PolicyError", "PolicyFileMissing"):
            return None
        player, said = self._asked_policy(), text
        for name in self._config.trial.players_of(self._group):
            before = f"trial.players: {name} cannot be played by {self._plays(name)}: "
            if text.startswith(before):
                player, said = name, text.removeprefix(before)
        if player is None:
            return None
        if place is None or self._plays(player).endswith(".onnx"):
            return self._in_config(self._player(player), short(f"{said}{self._where()}"))
        return self._at(place, short(f"{said}{self._where()}"))

    def _asked_policy(self) -> str | None:
        """The player whose policy was called last, if one was."""
        called = re.fullmatch(r"policy (.*) (act|reset)", self._report.get("call", ""))
        return called[1] if called else None

    def _callbacks(self) -> list[Diagnostic]:
        """What callbacks raise, and one that takes too long. Neither ends a game, but data are lacking then."""
        told = self._report.get("callbacks") or {}
        found = []
        for error in told.get("errors", ()):
            place = (self._name(error["file"]), error["line"]) if error["file"] else self._place_of(error["name"])
            text = f"{error['name']}() fails: {short(error['text'])}{remedy(error['type'], error['text'])}"
            found.append(self._at(place, text))
        if told.get("late"):
            text = (
                f"{told['late']}() takes longer than callbackSeconds ({self._config.trial.callback_seconds:g} s); "
                "callbacks are skipped until it has returned"
            )
            found.append(self._at(self._place_of(told["late"]), text, remark=True))
        return found

    def _nobody_matched(self) -> list[Diagnostic]:
        """A function `match` that puts nobody into a session. Told once, of the first group."""
        if self._group or self._report.get("matched") != 0:
            return []
        made_up = 3 * self._config.project.players
        said = f"match() made no session of {made_up} made-up participants: such participants wait on"
        return [self._at(self._place_of("match"), said, remark=True)]

    def _place_of(self, method: str) -> tuple[str, int | None]:
        return self._label or AGENT, line_of(self._code / AGENT, method)

    def _breach(self, text: str, place: tuple[str, int] | None) -> Diagnostic:
        """The agent does not keep the contract of docs/agent.md."""
        text = text.partition(": ")[2] or text  # without the error's own name
        if "trial.actionSpace" in text:
            message = "missing; list the game's actions, since the environment does not name them"
            return self._in_config(("trial", "actionSpace"), message)
        text = text.replace(str(self._code / AGENT), AGENT).replace(f" in {AGENT}", "")
        if text.startswith(f"{AGENT} has no"):
            return self._at(None, text.replace(f"{AGENT} has", "there is", 1))
        if self._config.project.has_sessions and "observations by player" in text:
            text += "; an environment with one player is for participants who play alone (project.players: 1)"
        method = _SIGNATURE.match(text)  # it says how a method is written, whichever was called
        if method:
            return self._at((self._label or AGENT, line_of(self._code / AGENT, method[1])), short(text))
        return self._at(place, short(text), whole="has no" in text)

    def _actions(self) -> list[Diagnostic]:
        names, count = self._report.get("names"), self._report.get("count")
        if not self._config.trial.action_space or count is None or names == count:
            return []
        if names > count and not self._report.get("foreign"):
            return []  # step() turns them into actions that there are
        message = f"has {names} names, but the environment has {count} actions"
        if names > count:
            message += "; take out the names of actions that it does not have, or let step() in agent.py translate them"
        return [self._in_config(("trial", "actionSpace"), message, remark=names < count)]

    def _arrows(self) -> list[Diagnostic]:
        """Arrows of `ui` and keys that do nothing, as far as the environment says what its actions are called."""
        names, source = self._report.get("actions", ()), read_source(self._folder)
        if not names:
            return []
        if names == [str(index) for index in range(len(names))]:
            found = remarks.arrows_of_unnamed_actions(self._config, len(names))
        else:
            found = remarks.arrows_without_an_action(self._config, names)
        arrows = [said for said in found if source.names(said.path)]
        keys = [] if self._config.trial.action_space else remarks.keys_without_an_action(self._config, names)
        return [self._in_config(*said, remark=True) for said in (*arrows, *keys)]

    def _call(self) -> str:
        call = self._report.get("call", "start")
        policy = self._asked_policy()
        if policy is not None:
            return f"{call.rpartition(' ')[2]}() of {printable(self._plays(policy))}"
        return {
            "policies": "making the policies",
            "start": f'start("{printable(self._config.trial.game or "")}")',
            "step": f"step({self._report.get('action', 0)})",
        }.get(call, f"{call}()")

    def _at(
        self, place: tuple[str, int | None] | None, message: str, *, remark: bool = False, whole: bool = False
    ) -> Diagnostic:
        """The problem at a line of the project's code, or else where the method that was called stands.

        `whole` is about the class and none of its methods.
        """
        if self._label is None:
            return self._in_config(("trial", "game"), message, remark=remark)
        file, line = place or (
            self._label,
            line_of(self._code / AGENT, "" if whole else self._report.get("call", "start")),
        )
        return Diagnostic(file, line, "", message, remark)

    def _in_config(self, path: Keys, message: str, remark: bool = False) -> Diagnostic:
        return read_source(self._folder).diagnostic(path, message, remark=remark)

    def _stack(self) -> str:
        """Where all threads were when the time was over; empty if it was not."""
        try:
            return (self._place / "report.stack").read_text(errors="replace")
        except OSError:
            return ""

    def _hung(self, stack: str) -> tuple[str, int] | None:
        """The line at which the project's code was then; None if it was not running."""
        frames = [(Path(found["file"]), int(found["line"])) for found in _FRAME.finditer(stack)]
        ours = [(self._name(file.name), line) for file, line in frames if file.parent == self._code]
        return ours[0] if ours else None

    def _name(self, file: str) -> str:
        """A file beside agent.py as messages name it."""
        return (Path(self._label or AGENT).parent / file).as_posix()

    def _last_words(self) -> str:
        lines = (self._place / "output").read_text(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return f": {short(said[-1])}" if said else ""


def slowness(pace: Pace, rate: int) -> str | None:
    """What to say if the agent is far slower than the frame rate (steps a second)."""
    seconds = pace.seconds - pace.slowest
    if seconds < LONG_ENOUGH or (pace.steps - 1) / seconds >= SLOW * rate:
        return None
    return f"it plays {(pace.steps - 1) / seconds:.2g} steps a second here; startingFrameRate is {rate}"


def _termination(status: int) -> str:
    if status < 0:
        with contextlib.suppress(ValueError):
            return f"signal {signal.Signals(-status).name}"
    return f"exit status {status}"
