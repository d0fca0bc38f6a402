"""What the researcher's terminal shows: one line for each event of a participant.

Most lines are made from documents as this process writes them. Servers write in processes of their own, so the log
looks for their participants' new answers, and for new errors in their logs. Ids are shortened, and answers are never
shown.
"""

from __future__ import annotations

import contextlib
import json
import re
import sys
import threading
from collections.abc import Iterable
from datetime import datetime
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.text import Text

from hippodrome.control.model import ids
from hippodrome.control.model.step_types import type_of
from hippodrome.local.activity.server_logs import WatchedServer
from hippodrome.local.backend.task_process import folder_of
from hippodrome.local.backend.tasks import ProcessTasks

LOOK = 0.5  # seconds between looks for what servers have written
ID_CHARACTERS = 6  # the characters of an id that are shown

_SESSION = re.compile(r"[^/]+/sessions/([^/]+)/session\.json")
_PERSON = re.compile(r"[^/]+/users/([^/]+)/(.+)\.json")
_REASONS = {
    "stopped": "stopped",
    "deadline": "maxRuntime was over",
    "ended": "the trial ended",
    "lost": "it was lost",
    "refused": "it cannot run",
    "no capacity": "there was no room",
    "full": "the project's limits are reached",
}
_CAUSES = {
    "ended at once": "its program ended before the game began",
    "never ready": "its agent was not ready in time",
    "crashed": "its program ended with an error",
    "killed": "its process was killed",
}
"""What is said of some lost servers instead, by the cause in their record (`hippodrome/control/servers/causes.py`)."""


class ActivityLog:
    """Shows what happens. Any thread may call it. No error of the terminal stops the study."""

    def __init__(self, console: Console | None = None) -> None:
        if console is None:
            with contextlib.suppress(AttributeError, OSError):
                sys.stdout.reconfigure(errors="replace")  # type: ignore[union-attr]
        self._console = console or Console(highlight=False, soft_wrap=True)
        self.named = False
        """Whether browsers find servers by their names (`TLS=1`)."""
        self.one_port = False
        """Whether browsers reach servers at the port of the pages (`--host`)."""
        self._lock = threading.Lock()
        self._states: dict[str, tuple[int, str]] = {}
        self._shown: set[str] = set()  # the keys of answers and the ids of sessions that were shown
        self._failing: set[str] = set()  # whose present server has written an error before it was ready
        self._last_steps: dict[str, str] = {}  # by project
        self._looking = threading.RLock()
        self._watched: dict[str, WatchedServer] = {}
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None

    # Showing lines

    def show(self, *lines: Text | str) -> None:
        """Show lines as they are."""
        with self._lock, contextlib.suppress(OSError, ValueError):  # the terminal may be gone
            for line in lines:
                self._console.print(line, markup=False)

    def say(self, text: str) -> None:
        """Show something that concerns all participants."""
        self._line("", text)

    def warn(self, text: str) -> None:
        """Show something that the researcher should look at."""
        self._line("", text, "yellow")

    def participant(self, user_id: str, text: str, style: str = "") -> None:
        """Show something that happens to a participant, in the Rich style `style`."""
        self._line(_short(user_id), text, style)

    def _line(self, who: str, text: str, style: str = "") -> None:
        line = Text.assemble((datetime.now().strftime("%H:%M:%S"), "dim"), "  ")
        line.append(f"{who:<{ID_CHARACTERS + 1}}  ", "cyan" if who else "")
        line.append(text, style)
        self.show(line)

    # What this process writes

    def set_steps(self, project_id: str, steps: Iterable[str]) -> None:
        """Set the keys of a project's steps, in order.

        A participant who answers the last step but one comes to the end.
        """
        keys = list(steps)
        self._last_steps[project_id] = keys[-2] if len(keys) > 1 else ""

    def wrote(self, key: str, body: bytes) -> None:
        """Show the event of a document that was just written: an arrival, an answer, a session, a server's new state.

        Other documents are not shown.
        """
        match, together, record = _PERSON.fullmatch(key), _SESSION.fullmatch(key), _json(body)
        if key.startswith("_servers/"):
            folder = folder_of(str(record.get("projectId")), str(record.get("userId")))
            self._reserved(str(record.get("warmServerName")), folder)
            self._catch_up(folder)
            self._server(record)
        elif match and match[2] == "participant":
            self._forget(key.removesuffix("participant.json"))
            group = record.get("group")
            self.participant(match[1], "arrived" if group is None else f"arrived, group {group}")
        elif together:
            self._plays_together(together[1], record)
        elif match and match[2] == "session":
            if record.get("unmatched"):
                self.participant(match[1], "found no others to play with", "yellow")
        elif match and match[2].startswith("answers/"):
            self._catch_up(key.partition("/answers/")[0])
            self._answer(key, match[1], record)

    def _plays_together(self, session_id: str, record: dict[str, Any]) -> None:
        """Show the members of a session, once. Later lines of their server have the session's id."""
        with self._lock:
            if session_id in self._shown:
                return
            self._shown.add(session_id)
        members = sorted(record.get("members", ()), key=lambda member: member.get("seat", 0))
        names = ", ".join(_short(str(member.get("userId"))) for member in members)
        lacking = int(record.get("players", 0)) - len(members)
        rest = f"; a policy plays in {lacking} place{'s' if lacking > 1 else ''}" if lacking > 0 else ""
        self.participant(session_id, f"{names} {'play together' if len(members) > 1 else 'plays'}{rest}")

    def _forget(self, folder: str) -> None:
        """Forget which answers of an arriving participant were shown: if their data were deleted, they answer again."""
        with self._lock:
            self._shown = {key for key in self._shown if not key.startswith(folder)}

    def _answer(self, key: str, user_id: str, record: dict[str, Any]) -> None:
        with self._lock:
            if key in self._shown:
                return
            self._shown.add(key)
        step, page = str(record.get("step", "?")), str(record.get("page", ""))
        kind = type_of(page)
        done = "played" if kind.on_server else "answered"
        if isinstance(answers := record.get("answers"), dict) and "completionCode" in answers and kind.on_server:
            done = "went on without the game of"
        self.participant(user_id, f"{done} step {step}" + (f" ({page})" if kind.has_files else ""))
        if step == self._last_steps.get(key.partition("/")[0]):
            self.participant(user_id, "came to the end of the study", "green")

    def _server(self, record: dict[str, Any]) -> None:
        try:
            user_id, attempt, state = record["userId"], int(record["attempt"]), str(record["state"])
        except (KeyError, TypeError, ValueError):
            return
        with self._lock:
            who = f"{record.get('projectId')}/{user_id}"
            same = self._states.get(who) == (attempt, state)
            self._states[who] = (attempt, state)
        if same or not (record.get("nonce") or record.get("token")):  # stopped before it began
            return
        if ids.is_warm_id(user_id):
            self._warm_server(record, state)
        elif state == "starting":
            self._failing.discard(user_id)
            self.participant(user_id, "server starting" + (f", attempt {attempt}" if attempt > 1 else ""))
        elif state == "ready":
            if user_id in self._failing:
                return  # it listens, but no game will begin on it
            which = "has a warm server" if record.get("warmServerName") else "server ready"
            # A server's name may be a participant's id, so it is not shown.
            where = "its name, port " if self.named else f"ws://{record.get('host')}:"
            self.participant(user_id, which if self.one_port else f"{which} at {where}{record.get('port')}")
        elif state == "closed":
            reason = str(record.get("reason"))
            text = f"server gone ({_CAUSES.get(str(record.get('cause'))) or _REASONS.get(reason, reason)})"
            self.participant(user_id, text, "yellow" if reason in ("lost", "refused", "no capacity", "full") else "")

    def _warm_server(self, record: dict[str, Any], state: str) -> None:
        """Show the state of a warm server. Once it is assigned, its lines are the participant's."""
        reason = str(record.get("reason"))
        if state in ("starting", "ready"):
            self.say(f"a warm server {'starts' if state == 'starting' else 'is ready'}")
        elif state == "closed" and reason == "full":
            self.say("no slot for another warm server just now: maxServers or maxServerHours is reached")
        elif state == "closed" and reason != "assigned":
            text = f"a warm server is gone ({_REASONS.get(reason, reason)})"
            (self.say if reason in ("stopped", "deadline") else self.warn)(text)

    # What servers write

    def follow(self, tasks: ProcessTasks, data: Path) -> None:
        """Follow the running servers until `close`. Lines that they wrote before this call are not shown."""
        self._look(tasks, data, whole_log=False)
        self._thread = threading.Thread(target=self._look_on, args=[tasks, data], name="activity", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        if self._thread:
            self._thread.join(2)

    def _look_on(self, tasks: ProcessTasks, data: Path) -> None:
        while not self._closed.wait(LOOK):
            with contextlib.suppress(OSError):  # the next look sees it
                self._look(tasks, data)
        with contextlib.suppress(OSError):
            self._look(tasks, data)

    def _look(self, tasks: ProcessTasks, data: Path, whole_log: bool = True) -> None:
        """Show the servers' new lines. `whole_log`: also earlier lines of servers that were not known."""
        running = {task.name: task for task in tasks.playing()}
        with self._looking:
            for name, task in running.items():
                watched = self._watched.get(name)
                if watched is None:
                    self._watched[name] = WatchedServer(task.folder, data, tasks.log(name), whole_log)
                elif task.folder and watched.folder != task.folder:  # a warm server has been assigned
                    self._tell(watched)
                    watched.assign(task.folder)
            for name, watched in list(self._watched.items()):
                self._tell(watched)
                if name not in running:
                    del self._watched[name]

    def _reserved(self, warm_server: str, folder: str) -> None:
        """Follow this warm server for the participant or session that gets it; by the next look it may have ended."""
        with self._looking:
            watched = self._watched.get(warm_server)
            if watched is not None and watched.folder != folder:
                self._tell(watched)
                watched.assign(folder)

    def _catch_up(self, folder: str) -> None:
        """Show the new lines of this folder's server, before the caller shows its own line about the folder."""
        with self._looking:
            for watched in self._watched.values():
                if watched.folder == folder:
                    self._tell(watched)

    def _tell(self, watched: WatchedServer) -> None:
        for key, body in watched.answers():
            self._answer(key, key.split("/")[2], _json(body))
        for text in watched.errors():
            self._failing.add(watched.user_id)
            self.participant(watched.user_id, text, "yellow")


def _short(user_id: str) -> str:
    return user_id if len(user_id) <= ID_CHARACTERS else f"{user_id[:ID_CHARACTERS]}…"


def _json(body: bytes) -> dict[str, Any]:
    try:
        parsed = json.loads(body)
    except ValueError:
        return {}
    return parsed if isinstance(parsed, dict) else {}
