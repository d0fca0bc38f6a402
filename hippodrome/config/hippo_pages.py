"""From which other sites the pages of a HIPPO Gym project load images, media and frames.

HIPPO's front end lets pages load them from anywhere. Here `project.allowedHosts` names the sites, and no
configuration of HIPPO has it: what its pages load is taken for allowed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from hippodrome.config.project_keys import origin
from hippodrome.participants.page_parser import PageParser

LIMIT = 50  # as many as `allowedHosts` may have

_LOADED = {
    "img": ("src", "srcset"),
    "source": ("src", "srcset"),
    "video": ("src", "poster"),
    "audio": ("src",),
    "track": ("src",),
    "iframe": ("src",),
}
_ORIGIN = re.compile(r"https://[^\s/?#\"'\\,]+", re.IGNORECASE)


def hosts(pages: Iterable[Path]) -> tuple[str, ...]:
    """The https origins from which these pages load something other than scripts and style sheets, each once.

    What cannot be read, or is no origin, is left out: the pages' own check says so.
    """
    found: dict[str, None] = {}
    for page in pages:
        reader = _Addresses()
        try:
            reader.feed(page.read_bytes().decode("utf-8", "replace"))
            reader.close()
        except OSError:
            continue
        found |= dict.fromkeys(reader.origins)
    return tuple(found)[:LIMIT]


class _Addresses(PageParser):
    def __init__(self) -> None:
        super().__init__()
        self.origins: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        wanted = _LOADED.get(tag, ())
        for name, value in attrs:
            if name in wanted:
                self._note(value or "", anywhere=name == "srcset")

    def _note(self, value: str, anywhere: bool) -> None:
        starts = _ORIGIN.findall(value) if anywhere else [found[0] for found in [_ORIGIN.match(value.strip())] if found]
        for start in starts:
            try:
                self.origins.append(origin(start.removesuffix(":443")))
            except ValueError:
                continue
