"""Finds the files of a project's pages: one file, or one for each group."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from hippodrome.control.config import layout
from hippodrome.protocol.similar import SIMILAR_FILES, did_you_mean

CLOSING = Path(__file__).with_name("pages") / "hippodrome-the-end.html"
"""The file of the last page of a study without pages (`hippo.CLOSING_PAGE`)."""
LIMIT_BYTES = 1024 * 1024

_VERSION = re.compile(r"(.+)-(?:0|[1-9][0-9]{0,5})")


class StepFileError(Exception):
    """A page's files have a mistake; `str()` says what to do, in a sentence."""


@dataclass(frozen=True, slots=True)
class StepFolder:
    """A project's folder of pages, and the names of its files as the disk has them."""

    path: Path
    names: tuple[str, ...]

    def find(self, page: str) -> tuple[int, tuple[Path, ...]]:
        """Return how many variants the page has, and its files. 0 variants: all participants get one page.

        Raises StepFileError if a file is missing, cannot be read, or does not fit the others.
        """
        groups = sorted(self._groups(page))
        single = f"{page}.html"
        if single in self.names and 0 in groups:
            raise StepFileError(
                f"both {single} and {page}-0.html are in {self.path.name}/; keep {single} for one page for all "
                f"participants, or {page}-0.html, {page}-1.html … for groups"
            )
        if single in self.names:
            return 0, (self._read(single),)
        if not groups:
            raise StepFileError(f"there is no {single} in {self.path.name}/{self._nearest(page)}")
        missing = next((k for k in range(len(groups)) if k != groups[k]), None)
        if missing is not None:
            raise StepFileError(
                f"there is no {single} in {self.path.name}/; if {page}-{groups[-1]}.html is the page of a group, "
                f"{page}-{missing}.html is missing (groups are numbered 0, 1, 2 … without gaps)"
            )
        return len(groups), tuple(self._read(f"{page}-{k}.html") for k in groups)

    def _groups(self, page: str) -> set[int]:
        pattern = re.compile(re.escape(page) + r"-(0|[1-9][0-9]{0,5})\.html")
        return {int(match[1]) for name in self.names if (match := pattern.fullmatch(name))}

    def _nearest(self, name: str) -> str:
        """The end of the message about a missing page: the page that was probably meant, as config.yml names it."""
        return did_you_mean(name, self._pages(), SIMILAR_FILES) or ("" if self.names else ", which is empty")

    def _pages(self) -> list[str]:
        """The names of all pages for config.yml: without `.html`, and without the number of a group."""
        stems = [name.removesuffix(".html") for name in self.names if name.endswith(".html")]
        pages = []
        for stem in stems:
            version = _VERSION.fullmatch(stem)
            pages.append(version[1] if version and f"{version[1]}-0" in stems else stem)
        return pages

    def _read(self, name: str) -> Path:
        """The file, after a check that it is text in UTF-8 of at most LIMIT_BYTES. Raises StepFileError."""
        file, label = self.path / name, f"{self.path.name}/{name}"
        try:
            if not file.is_file():
                raise StepFileError(f"{label} is not a file")
            with file.open("rb") as stream:
                data = stream.read(LIMIT_BYTES + 1)
        except OSError as error:
            raise StepFileError(f"{label} cannot be read: {error.strerror or 'unknown reason'}") from None
        if len(data) > LIMIT_BYTES:
            raise StepFileError(f"{label} is larger than 1 MB; put images and videos elsewhere and link to them")
        try:
            data.decode()
        except UnicodeDecodeError as error:
            line = data[: error.start].count(b"\n") + 1
            raise StepFileError(f"{label} is not UTF-8 text (line {line}); save it as UTF-8") from None
        return file


def open_folder(project: Path) -> StepFolder:
    """Return the project's folder of pages: `steps`, or that of HIPPO Gym's layout.

    Raises StepFileError if there is none, or it cannot be read.
    """
    try:
        path = layout.pages_folder(project)
        if path is not None:
            return StepFolder(path, tuple(sorted(entry.name for entry in path.iterdir())))
    except OSError as error:
        name = Path(error.filename or project).name
        raise StepFileError(f"the folder {name} cannot be read: {error.strerror or 'unknown reason'}") from None
    raise StepFileError("there is no folder steps (or StepFiles) beside the file; put the pages there")
