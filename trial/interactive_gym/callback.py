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
    """Several callbacks, given as classes, each called in turn.

    What they return is a map by the names of the classes (`Score`, `Score 2` …), without those that return None. One
    that raises keeps none of the others from being called; its error is raised after the last.
    """

    def __init__(self, callbacks: Iterable[type[GameCallback]], **_options: Any) -> None:
        super().__init__()
        self.callbacks = [make() for make in callbacks]

    def _tell_each(self, event: str, remote_game: Any) -> dict[str, Any] | None:
        returned: dict[str, Any] = {}
        raised: list[Exception] = []
        for name, each in zip(_names(self.callbacks), self.callbacks, strict=True):
            try:
                value = getattr(each, event)(remote_game)
            except Exception as error:  # noqa: BLE001 - the others are called all the same
                raised.append(error)
            else:
                if value is not None:
                    returned[name] = value
        if not raised:
            return returned or None
        if returned:
            remote_game.record(event, returned)
        raise raised[0]


def _names(callbacks: Iterable[Any]) -> list[str]:
    kinds = [type(each).__name__ for each in callbacks]
    counts = [kinds[: index + 1].count(kind) for index, kind in enumerate(kinds)]
    return [kind if count == 1 else f"{kind} {count}" for kind, count in zip(kinds, counts, strict=True)]


def _to_each(event: str) -> Any:
    def tell(self: MultiCallback, remote_game: Any) -> dict[str, Any] | None:
        return self._tell_each(event, remote_game)

    tell.__name__ = event
    return tell


for _event in EVENTS:
    setattr(MultiCallback, _event, _to_each(_event))
