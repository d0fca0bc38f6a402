"""Chooses the files of a project folder that go into its image.

Left out are config.yml and the pages, participants' data, hidden files, caches, virtual environments, and the files
that a `.dockerignore` in the folder names. Its rules are Docker's: patterns are relative to the folder, `**` is any
number of folders, `!` includes again, and the last line that matches decides.
"""

from __future__ import annotations

import fnmatch
import os
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from hippodrome.console.problem import Problem
from hippodrome.control.config import layout
from hippodrome.control.config.layout import REQUIREMENTS

LIMIT_BYTES = 1024**3  # the size of a project's own files, which each server pulls before its participant can play
LIMIT_FILES = 20_000

# Left out at the top of the folder only. A server gets config.yml when it starts (TRIAL), and the bucket has the pages.
# `run` keeps participants' data in `data`; `try` and `data` write to folders that begin with `data-`; `erase` writes
# receipts.
_TOP = (*layout.CONFIGS, *layout.PAGES, "data", "data-*", "erased-*.json", REQUIREMENTS)
_ANYWHERE = {"__pycache__", "node_modules"}
# Left out of the folder App of a clone of HIPPO Gym: its recordings, and the certificate that updateProject.py fetches.
# They may still be there if agent.py was moved to the folder above.
_OF_HIPPO = {"Trials", "fullchain.pem", "privkey.pem", "cert.pem", "private_key.pem"}


def project_files(folder: Path) -> dict[str, Path]:
    """Choose the files for the image. Return them by their paths below agent.py's folder, with slashes.

    They come from the project folder; of a clone of HIPPO Gym from its folder App, as in HIPPO's own images. Raises
    `Problem` if a file or link must not go into an image, or the files are too many or too large.
    """
    folder = folder.resolve()
    code = layout.agent_folder(folder)
    if not inside(folder, code):
        name = code.relative_to(folder).as_posix()
        raise Problem(f"{name} is a link out of the project folder.", "Put the folder itself there.")
    ignored = Ignore.of(folder)
    paths: dict[str, Path] = {}
    size = 0
    for path in _walk(folder, code, ignored):
        name = path.relative_to(folder).as_posix()
        real = _target(folder, path, name, ignored)
        paths[path.relative_to(code).as_posix()] = real
        size += real.stat().st_size
        if size > LIMIT_BYTES or len(paths) > LIMIT_FILES:
            raise _too_much(paths, size)
    return dict(sorted(paths.items()))


def inside(folder: Path, path: Path) -> bool:
    """Whether the path leads to a file or folder inside `folder`, links included."""
    real = _without_links(path)
    return real is not None and real.is_relative_to(folder.resolve())


class Ignore:
    """The lines of a `.dockerignore`."""

    def __init__(self, lines: Sequence[str]) -> None:
        self._rules: list[tuple[bool, re.Pattern[str]]] = []
        for line in lines:
            pattern = line.strip()
            if not pattern or line.startswith("#"):
                continue
            keep = pattern.startswith("!")
            pattern = pattern.removeprefix("!").strip()
            parts = [part for part in pattern.split("/") if part not in ("", ".")]
            if parts:
                self._rules.append((keep, re.compile(_expression(parts))))
        self.may_take_back = any(keep for keep, _ in self._rules)

    @classmethod
    def of(cls, folder: Path) -> Ignore:
        """Read the folder's `.dockerignore`; without one, nothing is ignored. Raises `Problem` if it cannot be read."""
        file = folder / ".dockerignore"
        try:
            return cls(file.read_text(encoding="utf-8-sig").splitlines() if file.is_file() else [])
        except (OSError, UnicodeDecodeError):
            raise Problem(".dockerignore cannot be read.", "Save it as UTF-8 text, or remove it.") from None

    def __call__(self, name: str) -> bool:
        """Whether the file or folder of this name (with slashes) is ignored, itself or by a folder above it."""
        ignored = False
        for keep, pattern in self._rules:
            if pattern.match(name):
                ignored = not keep
        return ignored


def _expression(parts: Sequence[str]) -> str:
    """Make a pattern's regular expression, which matches a path, or the beginning of a path before a slash."""
    text = ""
    for index, part in enumerate(parts):
        last = index == len(parts) - 1
        if part == "**":
            text += ".*" if last else "(?:[^/]+/)*"
        else:
            text += _segment(part) + ("" if last else "/")
    return rf"{text}(?:/|\Z)"


def _segment(part: str) -> str:
    """Make the regular expression of a part of a pattern. Its `*`, `?` and `[…]` match no slash."""
    text, index = "", 0
    while index < len(part):
        char = part[index]
        end = part.find("]", index + 2) if char == "[" else -1
        if char == "*":
            text += "[^/]*"
        elif char == "?":
            text += "[^/]"
        elif char == "\\" and index + 1 < len(part):
            index += 1
            text += re.escape(part[index])
        elif end > 0:
            inner = part[index + 1 : end].replace("\\", "\\\\").replace("[", "\\[")
            text += f"(?!/)[{inner}]"
            index = end
        else:
            text += re.escape(char)
        index += 1
    return text


def _walk(root: Path, folder: Path, ignored: Ignore) -> Iterator[Path]:
    try:
        entries = sorted(folder.iterdir())
    except OSError as error:
        raise Problem(
            f"The folder {folder} cannot be read: {error.strerror}.",
            "Change its permissions, or name it in .dockerignore if the agent does not need it.",
        ) from None
    for path in entries:
        name = path.relative_to(root).as_posix()
        if _never_included(root, path) or (ignored(name) and not (path.is_dir() and ignored.may_take_back)):
            continue
        if path.is_dir() and not path.is_symlink():
            if not (path / "pyvenv.cfg").is_file():
                yield from _walk(root, path, ignored)
        elif not ignored(name):
            yield path


def _never_included(root: Path, path: Path) -> bool:
    """Whether a file or folder is left out, whatever .dockerignore says."""
    return (
        path.name.startswith(".")
        or path.name in _ANYWHERE
        or fnmatch.fnmatchcase(path.name, "*.py[co]")
        or (path.parent == root and _at_top(path))
        or (path.parent in _apps(root) and _left_in_app(root, path))
    )


def _left_in_app(root: Path, path: Path) -> bool:
    """Whether a file or folder in App/ is left out. If agent.py is in App/, App/ counts as the top of the folder."""
    return path.name in _OF_HIPPO or (_at_top(path) and path.parent == layout.agent_folder(root))


def _at_top(path: Path) -> bool:
    return any(fnmatch.fnmatchcase(path.name, pattern) for pattern in _TOP)


def _apps(root: Path) -> list[Path]:
    return [root / app for app in layout.APPS]


def _without_links(path: Path) -> Path | None:
    """Resolve all links in the path. Return None if a link leads to itself, or cannot be followed."""
    try:
        return Path(os.path.realpath(path, strict=True))  # not Path.resolve: from Python 3.13 on it accepts circles
    except FileNotFoundError:
        return path.resolve()
    except OSError:
        return None


def _target(root: Path, path: Path, name: str, ignored: Ignore) -> Path:
    """Return the file to which the path leads.

    Raises `Problem` if a link leads to a file that the image must not have.
    """
    real = _without_links(path)
    if real is None:
        raise Problem(f"{name} is a link that leads to itself.", "Remove it.")
    if path.is_symlink():
        if not real.is_relative_to(root):
            raise Problem(
                f"{name} is a link out of the project folder.",
                "Put the file itself there, or name the link in .dockerignore.",
            )
        steps = [*real.relative_to(root).parents, real.relative_to(root)]
        if any(_never_included(root, root / step) or ignored(step.as_posix()) for step in steps if step.parts):
            raise Problem(f"{name} is a link to something that is left out of the image.", "Put the file itself there.")
        if real.is_dir():
            raise Problem(f"{name} is a link to a folder.", "Put the folder itself there, or name it in .dockerignore.")
    if not real.is_file():
        raise Problem(f"{name} is not a file.", "Remove it, or name it in .dockerignore.")
    return real


def _too_much(paths: dict[str, Path], size: int) -> Problem:
    if len(paths) > LIMIT_FILES:
        return Problem(
            f"The project folder has more than {LIMIT_FILES:,} files for the image.",
            "Name folders that the agent does not need in a file .dockerignore beside config.yml.",
        )
    biggest = sorted(((path.stat().st_size, name) for name, path in paths.items()), reverse=True)[:5]
    return Problem(
        f"The project's files for the image are more than {LIMIT_BYTES / 1024**3:g} GB.",
        "Name what the agent does not need in a file .dockerignore beside config.yml.",
        [f"{bytes_ / 1024**2:8.1f} MB  {name}" for bytes_, name in biggest],
    )
