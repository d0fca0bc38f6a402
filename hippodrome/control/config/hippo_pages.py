"""Finds the sites from which the pages of a HIPPO Gym project load images, media and frames.

HIPPO's front end lets pages load them from any site. Hippodrome needs the sites in `project.allowedHosts`, which no
configuration of HIPPO has. So the sites from which the project's pages load are added to that list.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Iterator
from pathlib import Path

from hippodrome.control.config.project_keys import MAX_HOSTS, origin
from hippodrome.control.participants import markup

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
        with contextlib.suppress(OSError):
            origins |= dict.fromkeys(_origins(page.read_bytes().decode("utf-8", "replace")))
    return tuple(origins)[:MAX_HOSTS]


def _origins(page: str) -> Iterator[str]:
    for token in markup.tokens(page):
        for name, value in markup.attributes(token.attributes).items():
            if name not in _LOADED.get(token.start, ()):
                continue
            if name == "srcset":  # this attribute has several addresses
                starts = _ORIGIN.findall(value)
            else:
                first = _ORIGIN.match(value.strip())
                starts = [first[0]] if first else []
            for start in starts:
                with contextlib.suppress(ValueError):
                    yield origin(start.removesuffix(":443"))
