"""Batches: items are processed independently and may run at the same time; one failure does not affect the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TypeVar

from hippodrome.log import failure
from hippodrome.ports import Platform

I = TypeVar("I")  # noqa: E741 - the items
T = TypeVar("T")


def each(
    platform: Platform,
    items: Iterable[I],
    act: Callable[[I], T | None],
    trouble: str,
    name: Callable[[I], str] | None = None,
) -> tuple[list[tuple[I, T]], list[I]]:
    """What `act` makes of each item, without the Nones, and the items for which it failed.

    A failure is logged under the text `trouble`, with the `name` of its server. The acts may run at the same time.
    """

    def one(item: I) -> tuple[I, T | None, bool]:
        try:
            return item, act(item), True
        except Exception as error:  # noqa: BLE001 - see above
            failure(trouble, error, **({"server": name(item)} if name else {}))
            return item, None, False

    results = platform.together([lambda item=item: one(item) for item in items])  # type: ignore[misc]
    made = [(item, result) for item, result, _ in results if result is not None]
    return made, [item for item, _, well in results if not well]
