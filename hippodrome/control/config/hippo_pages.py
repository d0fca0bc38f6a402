"""Finds the sites from which the pages of a HIPPO Gym project load images, media and frames.

HIPPO's front end lets pages load them from any site. Hippodrome needs the sites in `project.allowedHosts`, which no
configuration of HIPPO has. So the sites from which the project's pages load are added to that list.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable
from pathlib import Path

from hippodrome.control.config.project_keys import MAX_HOSTS, origin
from hippodrome.control.participants.page_parser import PageParser

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
    """Return the https origins from which these pages load images, media and frames, each once and at most MAX_HOSTS.

    Files that cannot be read and addresses that are no origins are left out: other checks report them.
    """
    origins: dict[str, None] = {}
    for page in pages:
        reader = _Addresses()
        try:
            reader.feed(page.read_bytes().decode("utf-8", "replace"))
            reader.close()
        except OSError:
            continue
        origins |= dict.fromkeys(reader.origins)
    return tuple(origins)[:MAX_HOSTS]


class _Addresses(PageParser):
    def __init__(self) -> None:
        super().__init__()
        self.origins: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name not in _LOADED.get(tag, ()):
                continue
            if name == "srcset":  # this attribute has several addresses
                starts = _ORIGIN.findall(value or "")
            else:
                first = _ORIGIN.match((value or "").strip())
                starts = [first[0]] if first else []
            for start in starts:
                with contextlib.suppress(ValueError):
                    self.origins.append(origin(start.removesuffix(":443")))
