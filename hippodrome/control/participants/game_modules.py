"""The modules of `hippodrome/web/game/` that only some projects need, with the condition for each.

The game page of every project has `main.js` and the modules that it imports. It does not import the modules in this
table: each adds itself to `hippodrome/web/game/hooks.js` when it is loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hippodrome.control.model.project import GAME_PAGES, Project
from hippodrome.control.model.texts import Texts


def _has_scene(trial: Mapping[str, Any]) -> bool:
    """Whether the game is drawn by objects (docs/objects.md)."""
    return trial.get("scene") is not None


def has_chat(trial: Mapping[str, Any]) -> bool:
    """Whether participants talk (`trial.chat`)."""
    return trial.get("chat") not in (None, False)


def is_talk(trial: Mapping[str, Any]) -> bool:
    """Whether there is no game beside the talk."""
    return trial.get("game") == TALK


def _jumps(trial: Mapping[str, Any]) -> bool:
    """Whether the game has a button for up, and none for down."""
    ui = trial.get("ui")
    return isinstance(ui, Mapping) and ui.get("up") is True and not ui.get("down")


TALK = "talk"
"""The built-in game (`trial.game`) in which participants only talk, as in `hippodrome.protocol.trial`."""
MODULES: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {
    "keys.js": lambda trial: bool(trial.get("keys")),
    "labels.js": lambda trial: bool(trial.get("labels")),
    "rates.js": lambda trial: trial.get("allowFrameRateChange") is True,
    "reading.js": lambda trial: any(isinstance(trial.get(key), str) for key in GAME_PAGES),
    "turns.js": lambda trial: trial.get("pace") == "turns",
    "countdown.js": lambda trial: bool(trial.get("resetFreeze") or trial.get("episodeSeconds")),
    "thumbs.js": _jumps,
    "chat.js": lambda trial: has_chat(trial) or is_talk(trial),
    **dict.fromkeys(("painter.js", "scene.js", "sprites.js"), _has_scene),
}
"""By file name in `hippodrome/web/game/`: whether a project with this registered `trial` section needs the module."""

OWN_WORDS = ("words.js",)
"""The module for studies with words of their own for the sentences of servers."""
TOGETHER = ("people.js", "lobby.js")
"""The modules of a game for several participants. `lobby.js` is last: the code after it waits for the match."""


def texts_of(project: Project) -> Texts:
    """Return the texts of the game page: those of a conversation if the game is `talk`."""
    texts = Texts(project.texts)
    return texts.in_talk() if is_talk(project.trial) else texts


def modules_of(project: Project) -> tuple[str, ...]:
    """Return the names of the modules that a project needs besides `main.js` and its imports."""
    own = tuple(name for name, needed in MODULES.items() if needed(project.trial))
    own += OWN_WORDS if texts_of(project).of_server() else ()
    return own + TOGETHER if project.has_sessions else own
