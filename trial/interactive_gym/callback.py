"""Interactive Gym's callbacks: methods that are told of the game as it goes on."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

EVENTS = (
    "on_episode_start",
    "on_episode_end",
    "on_game_tick_start",
    "on_game_tick_end",
    "on_graphics_start",
    "on_graphics_end",
    "on_waitroom_start",
    "on_waitroom_join",
    "on_waitroom_end",
    "on_waitroom_timeout",
    "on_game_end",
)
"""Each gets a `RemoteGame`. There are no waiting rooms here yet, so those of the waiting room are never called."""


class GameCallback:
    """A callback that does nothing: a base for callbacks of one's own."""

    def __init__(self, **_options: Any) -> None:
        """Interactive Gym passes options on."""

    def on_episode_start(self, remote_game: Any) -> Any:
        """An episode has begun."""

    def on_episode_end(self, remote_game: Any) -> Any:
        """An episode has ended."""

    def on_game_tick_start(self, remote_game: Any) -> Any:
        """A step comes next."""

    def on_game_tick_end(self, remote_game: Any) -> Any:
        """A step has been taken."""

    def on_graphics_start(self, remote_game: Any) -> Any:
        """After a step, before `on_graphics_end`."""

    def on_graphics_end(self, remote_game: Any) -> Any:
        """After `on_graphics_start`."""

    def on_waitroom_start(self, remote_game: Any) -> Any:
        """Never called."""

    def on_waitroom_join(self, remote_game: Any) -> Any:
        """Never called."""

    def on_waitroom_end(self, remote_game: Any) -> Any:
        """Never called."""

    def on_waitroom_timeout(self, remote_game: Any) -> Any:
        """Never called."""

    def on_game_end(self, remote_game: Any) -> Any:
        """The trial is over."""


class MultiCallback(GameCallback):
    """Several callbacks, given as classes, each called in turn."""

    def __init__(self, callbacks: Iterable[type[GameCallback]], **_options: Any) -> None:
        super().__init__()
        self.callbacks = [make() for make in callbacks]


def _to_each(event: str) -> Any:
    def tell(self: MultiCallback, remote_game: Any) -> None:
        for each in self.callbacks:
            getattr(each, event)(remote_game)

    tell.__name__ = event
    return tell


for _event in EVENTS:
    setattr(MultiCallback, _event, _to_each(_event))
