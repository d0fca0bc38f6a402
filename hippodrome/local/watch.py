"""Watches the project's files while the study runs, and publishes it again when one changes."""

from __future__ import annotations

import contextlib
import os
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path

from hippodrome.control.config import Config, Diagnostic, layout
from hippodrome.local.backend.files import names
from hippodrome.local.backend.retry import message_for
from hippodrome.local.check.agent_file import read_module
from hippodrome.local.check.command import check_project
from hippodrome.local.publish import NotPublished, step_files

_GONE = (FileNotFoundError, NotADirectoryError)
LOOK = 0.5  # seconds between looks; a change is complete when two looks in a row see the same
Seen = Mapping[str, tuple[int, int]]
Say = Callable[[str], None]


class Watch:
    """Looks at the project's files, and publishes the project again when one changes.

    `config` is the project as it was published last. `publish` publishes it again and returns it, or raises
    NotPublished; `published` is called with the project that `publish` has returned.
    """

    def __init__(
        self,
        folder: Path,
        config: Config,
        publish: Callable[[], Config],
        published: Callable[[Config], None],
        say: Say,
    ) -> None:
        self._folder = folder
        self._config = config
        self._publish_all = publish
        self._published = published
        self._say = say
        self._held_back = False  # whether the last change was not published
        self._refused = ""  # the error of this machine that kept a change from being published
        self._wrong: set[Diagnostic] = set()  # the problems of pages and agent.py at the last check
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="watch", daemon=True)
        self._known = self._look()

    def start(self) -> None:
        """Show the problems of pages and agent.py, and begin to look for changes."""
        self._check()
        self._thread.start()

    def close(self) -> None:
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join(2)

    def _work(self) -> None:
        last = self._known
        while not self._closed.wait(LOOK):
            try:
                file_times = self._look()
            except OSError:  # a file that cannot be seen now is not gone
                continue
            if file_times == last != self._known:  # the change is complete
                before, self._known = self._known, file_times
                self._changed(sorted({name for name, _ in before.items() ^ file_times.items()}))
            elif self._refused:
                self._publish()
            last = file_times

    def _changed(self, changed: list[str]) -> None:
        unreadable: list[Diagnostic] = []
        for name in changed:
            exists = name in self._known
            is_code = name.endswith(".py") and exists
            mistakes = read_module(self._folder / name, name) if is_code else []
            for mistake in mistakes:
                self._say(f"{mistake}; servers that start from now on fail until it is mended")
            if not mistakes:
                later = ": servers that start from now on run it" if is_code else ""
                self._say(f"{name}{' changed' if exists else ' is gone'}{later}")
            unreadable += mistakes
        warm = self._config.project.warm_servers  # warm servers run the code with which they started
        if warm or not all(name.endswith(".py") for name in changed):
            self._publish()
        if not self._held_back:
            self._check(changed, unreadable)

    def _publish(self) -> None:
        held_back, self._held_back = self._held_back, True
        refused, self._refused = self._refused, ""
        try:
            self._config = self._publish_all()
            self._published(self._config)
        except NotPublished as error:
            self._say("The study goes on as it was, because of this:")
            for problem in error.problems:
                self._say(f"  {problem}")
        except OSError as error:  # such as a full disk: the next look tries again
            self._refused = message_for(error)
            if self._refused != refused:
                self._say(f"The study goes on as it was. {self._refused}")
        except Exception as error:  # noqa: BLE001 - the next change tries again
            self._say(f"The study goes on as it was: {type(error).__name__}: {error}")
        else:
            self._held_back = False
            if held_back:
                self._say("The project is fine again, and the study goes on as it says now")

    def _check(self, changed: Collection[str] = (), shown: Collection[Diagnostic] = ()) -> None:
        """Show the problems of pages and agent.py that are new or concern the changed files, without those `shown`."""
        try:
            found = check_project(self._folder, self._config)
        except Exception as error:  # noqa: BLE001 - the study goes on
            self._say(f"The pages could not be checked: {type(error).__name__}: {error}")
            return
        for problem in found:
            if problem not in shown and (problem not in self._wrong or problem.file in changed):
                self._say(str(problem))
        before, self._wrong = self._wrong, set(found)
        if _mistaken(before) and not _mistaken(self._wrong):
            self._say("No mistakes are left")

    def _look(self) -> Seen:
        """By file of the project: when it changed last (ns), and its size. Raises OSError if that cannot be seen."""
        file_times = {}
        files = [self._folder / name for name in layout.config_names()]
        with contextlib.suppress(*_GONE):
            files += step_files(self._folder)
        code = layout.agent_folder(self._folder)
        with contextlib.suppress(*_GONE):
            files += [code / name for name in names(code, ".py")]
        for file in files:
            with contextlib.suppress(*_GONE):
                status = os.stat(file)
                file_times[file.relative_to(self._folder).as_posix()] = (status.st_mtime_ns, status.st_size)
        return file_times


def _mistaken(problems: Iterable[Diagnostic]) -> bool:
    return any(not problem.remark for problem in problems)
