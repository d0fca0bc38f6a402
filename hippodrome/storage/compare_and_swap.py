"""Shared documents that many functions change at once: read, change, write on condition, and again if that failed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from hippodrome.log import failure
from hippodrome.model.records import Record, from_json, to_json
from hippodrome.ports import Conflict, Documents
from hippodrome.storage.repository import RetryLater

TRIES = 40  # at a compare-and-swap: twenty functions may start servers of one project at once

R = TypeVar("R", bound=Record)


class Changed(NamedTuple, Generic[R]):
    """What a document was, and what it has become."""

    before: R
    after: R


class SharedDocuments:
    """Typed compare-and-swap. A document that does not exist reads as an empty record of its kind."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents

    def read(self, key: str, kind: type[R]) -> R:
        """The record under a key. One call."""
        found = self._documents.get(key)
        return from_json(found.body, kind) if found else kind()

    def change(self, key: str, kind: type[R], change: Callable[[R], R], *, renew: bool = False) -> Changed[R]:
        """Apply `change` and write what it makes of the record, reading it anew as often as somebody else was faster.

        Nothing is written if `change` gives back what it got: one call then, else two. Raises `RetryLater` if it never
        settles, and a ValueError or RecursionError if the document holds no such record: nothing is written then. With
        `renew`, which is for what can be made anew, such a document is replaced instead.
        """
        for _ in range(TRIES):
            found = self._documents.get(key)
            before, unread = kind(), False
            if found:
                try:
                    before = from_json(found.body, kind)
                except (ValueError, RecursionError) as error:
                    if not renew:
                        raise
                    unread = True
                    failure("a document cannot be read and is made anew", error, kind=kind.__name__)
            after = change(before)
            if after == before and not unread:
                return Changed(before, after)
            try:
                if found:
                    self._documents.replace(key, to_json(after), found.etag)
                else:
                    self._documents.create(key, to_json(after))
            except Conflict:
                continue
            return Changed(before, after)
        raise RetryLater("it keeps changing")
