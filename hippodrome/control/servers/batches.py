"""Processes the items of a batch independently, possibly at the same time. One failure does not affect the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from hippodrome.control.log import failure
from hippodrome.control.ports import Platform

I = TypeVar("I")  # noqa: E741 - the items
T = TypeVar("T")


def for_each(
    platform: Platform,
    items: Iterable[I],
    act: Callable[[I], T | None],
    log_text: str,
    name: Callable[[I], str] | None = None,
) -> tuple[list[tuple[I, T]], list[I]]:
    """Call `act` on each item. One failure does not affect the other items.

    Returns two lists: the items whose result is not None, each with its result; and the items for which `act` raised.
    Each error is logged with the text `log_text`, and with the server's name that `name` returns for the item.
    """

    def one(item: I) -> tuple[I, T | None, bool]:
        try:
            return item, act(item), True
        except Exception as error:  # noqa: BLE001 - logged; the other items go on
            failure(log_text, error, **({"server": name(item)} if name else {}))
            return item, None, False

    results = platform.run_all([lambda item=item: one(item) for item in items])  # type: ignore[misc]
    done = [(item, result) for item, result, _ in results if result is not None]
    return done, [item for item, _, succeeded in results if not succeeded]
