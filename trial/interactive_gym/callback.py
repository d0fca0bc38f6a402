"""Interactive Gym's callbacks: methods that are called at the events of a game."""

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
"""The methods' names. Each method gets a `RemoteGame`. Those of the waiting room are never called: participants wait in
the lobby, before their server runs."""


class GameCallback:
    """A callback that does nothing: the base class of an experiment's callbacks."""

    def __init__(self, **_options: Any) -> None:
        """Take any options, as Interactive Gym does."""

    def on_episode_start(self, remote_game: Any) -> Any:
        """Do nothing. Called when an episode has begun."""

    def on_episode_end(self, remote_game: Any) -> Any:
        """Do nothing. Called when an episode has ended."""

    def on_game_tick_start(self, remote_game: Any) -> Any:
        """Do nothing. Called before each step."""

    def on_game_tick_end(self, remote_game: Any) -> Any:
        """Do nothing. Called after each step."""

    def on_graphics_start(self, remote_game: Any) -> Any:
        """Do nothing. Called after each step, after `on_game_tick_end`."""

    def on_graphics_end(self, remote_game: Any) -> Any:
        """Do nothing. Called after each step, after `on_graphics_start`."""

    def on_waitroom_start(self, remote_game: Any) -> Any:
        """Never called."""

    def on_waitroom_join(self, remote_game: Any) -> Any:
        """Never called."""

    def on_waitroom_end(self, remote_game: Any) -> Any:
        """Never called."""

    def on_waitroom_timeout(self, remote_game: Any) -> Any:
        """Never called."""

    def on_game_end(self, remote_game: Any) -> Any:
        """Do nothing. Called when the trial ends in the middle of an episode."""


class MultiCallback(GameCallback):
    """Calls several callbacks in turn; `callbacks` are their classes.

    Each method returns a map of the values that the callbacks return, by the names of their classes (`Score`, `Score 2`
    …), without None. If a callback raises, the others are still called. Then the first exception is raised.
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
            except Exception as error:  # noqa: BLE001 - the others are still called
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
