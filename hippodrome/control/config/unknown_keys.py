"""Explains an unknown key: as a typing error, as a key in the wrong section, or as neither."""

from __future__ import annotations

from hippodrome.control.config.project_keys import NAMES, STEPS, TEXTS
from hippodrome.control.model.step_order import FINAL
from hippodrome.control.model.texts import ENGLISH
from hippodrome.protocol.similar import SIMILAR, nearest
from hippodrome.protocol.values import KeyPath, path_text

_LIKELY, _LIKELY_ELSEWHERE = 0.8, 0.9
"""How similar an unknown key must be to a known one to be most likely a typing error: for a key of the same section,
and for a key of another section (difflib's ratio, from 0 to 1)."""


_ELSEWHERE = {section: names for section, names in NAMES.items() if section != ("trial", "scene")}
"""The sections to which an unknown key may belong. The keys of `scene`, such as width, are too common to tell."""


_AROUND_TEXTS = ((), TEXTS[:-1])
"""The sections in which texts stand if they are not indented far enough."""


def explain(path: KeyPath) -> tuple[str, list[KeyPath]]:
    """Return the message about an unknown key, and the path of the key that was probably meant.

    The path is in a list, which is empty if no known key is similar enough.
    """
    section, key = path[:-1], str(path[-1])
    own = "a key of your agent's own goes under trial.options" if section == ("trial",) else ""
    home = _home(key, section)
    if home is not None:
        place = f"under {path_text(home)}" if home else "at the top of the file, not indented"
        return f"unknown key; it belongs {place} (check the indentation)", [(*home, key)]
    meant = _similar(path, SIMILAR, SIMILAR)
    if meant is not None:
        question = f"did you mean {meant[-1] if meant[:-1] == section else path_text(meant)}?"
        return f"unknown key; {question}" + (f" If not, {own}" if own else ""), [meant]
    names_here = sorted(NAMES[section])
    which = f"the keys here are {', '.join(names_here)}" if len(names_here) <= 5 else "docs/config.md lists all keys"
    return f"unknown key; {which}" + (f"; {own}" if own else ""), []


def meant_for(path: KeyPath) -> KeyPath | None:
    """Return the path of the key that was most likely meant by an unknown key; None if no known key is similar enough.

    The unknown key is a known key in the wrong section, or has a typing error.
    """
    section, key = path[:-1], str(path[-1])
    home = _home(key, section)
    return _similar(path, _LIKELY, _LIKELY_ELSEWHERE) if home is None else (*home, key)


def _similar(path: KeyPath, here: float, elsewhere: float) -> KeyPath | None:
    """The path of the known key that is most similar to an unknown one; None if no known key is similar enough.

    `here` is how similar a key of the same section must be, and `elsewhere` a key of another section.
    """
    for section in (path[:-1], *_ELSEWHERE):
        similar = nearest(str(path[-1]), sorted(NAMES[section]), here if section == path[:-1] else elsewhere)
        if similar:
            return (*section, similar)
    return None


def _home(key: str, section: KeyPath) -> KeyPath | None:
    """The section to which a key belongs that stands in `section`; None if no section has this key."""
    if key == FINAL or key.isdecimal():
        return STEPS
    texts = TEXTS if key in ENGLISH and section in _AROUND_TEXTS else None
    return next((home for home, keys in _ELSEWHERE.items() if key in keys), texts)
