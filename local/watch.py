"""Watches the project's files while the study is held, and publishes what changes."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from hippodrome.config import Config, Diagnostic, layout
from local.backend.files import names
from local.backend.retry import message_for
from local.check.project import check_project
from local.publish import NotPublished, step_files

LOOK = 0.5  # seconds; a change is published when two looks in a row see the same
Seen = Mapping[str, tuple[int, int]]
Say = Callable[[str], None]


class Watch:
    """Looks at the project's files, and publishes what changes. `published` is told of each time.

    `config` is the project as it was published; `publish` does it again, and raises NotPublished.
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
        self._held_back = False  # the study goes on as it was
        self._refused = ""  # what this machine refused when a change was to be published
        self._wrong: set[Diagnostic] = set()  # what is known to be wrong with pages and agent.py
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._work, name="watch", daemon=True)
        self._known = self._look()

    def start(self) -> None:
        """Say what is wrong with the pages, and go on looking."""
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
                seen = self._look()
            except OSError:  # what cannot be seen is not gone: the next look sees it
                continue
            if seen == last != self._known:  # the change is complete
                before, self._known = self._known, seen
                self._changed(sorted({name for name, _ in before.items() ^ seen.items()}))
            elif self._refused:
                self._publish()
            last = seen

    def _changed(self, changed: list[str]) -> None:
        for name in changed:
            gone = "" if name in self._known else " is gone"
            later = ": servers that start from now on run it" if name.endswith(".py") and not gone else ""
            self._say(f"{name}{gone or ' changed'}{later}")
        warm = self._config.project.warm_servers  # those that wait run what was there when they started
        if warm or not all(name.endswith(".py") for name in changed):
            self._publish()
        if not self._held_back:
            self._check(changed)

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
        except OSError as error:  # a full disk, or a file that vanishes while it is read: the next look tries again
            self._refused = message_for(error)
            if self._refused != refused:
                self._say(f"The study goes on as it was. {self._refused}")
        except Exception as error:  # noqa: BLE001 - the next change tries again
            self._say(f"The study goes on as it was: {type(error).__name__}: {error}")
        else:
            self._held_back = False
            if held_back:
                self._say("The project is fine again, and the study goes on as it says now")

    def _check(self, changed: Collection[str] = ()) -> None:
        """Say what is wrong with the pages and agent.py: what is new, and what concerns these files."""
        try:
            found = check_project(self._folder, self._config)
        except Exception as error:  # noqa: BLE001 - the study is held all the same
            self._say(f"The pages could not be checked: {type(error).__name__}: {error}")
            return
        for problem in found:
            if problem not in self._wrong or problem.file in changed:
                self._say(str(problem))
        before, self._wrong = self._wrong, set(found)
        if _mistaken(before) and not _mistaken(self._wrong):
            self._say("No mistakes are left")

    def _look(self) -> Seen:
        """When each file of the project changed last, and its size. Raises OSError if that cannot be seen."""
        seen = {}
        files = [self._folder / name for name in layout.config_names()] + _gone_or(lambda: step_files(self._folder))
        code = layout.agent_folder(self._folder)
        files += _gone_or(lambda: [code / name for name in names(code, ".py")])
        for file in files:
            for status in _gone_or(lambda file=file: [os.stat(file)]):  # type: ignore[misc]
                seen[file.relative_to(self._folder).as_posix()] = (status.st_mtime_ns, status.st_size)
        return seen


def _mistaken(problems: Iterable[Diagnostic]) -> bool:
    return any(not problem.remark for problem in problems)


def _gone_or(look: Callable[[], list[Any]]) -> list[Any]:
    """What is there; nothing if it vanishes meanwhile."""
    try:
        return look()
    except (FileNotFoundError, NotADirectoryError):
        return []
