"""Changes documents that several functions change at once: read, change, write conditionally; retry on a conflict."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

from hippodrome.control.log import failure
from hippodrome.control.model.records import Record, from_json, to_json
from hippodrome.control.ports import Conflict, Documents, RetryLater

TRIES = 40  # for one change: twenty functions may start servers of one project at once

R = TypeVar("R", bound=Record)


class Changed(NamedTuple, Generic[R]):
    """A document's record before a change and after it."""

    before: R
    after: R


class SharedDocuments:
    """Typed compare-and-swap. A document that does not exist is read as an empty record of its kind."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents

    def read(self, key: str, kind: type[R]) -> R:
        """Return the record under a key; an empty one if there is no document. AWS calls: one.

        Raises ValueError if the document cannot be read as such a record.
        """
        document = self._documents.get(key)
        return from_json(document.body, kind) if document else kind()

    def change(self, key: str, kind: type[R], change: Callable[[R], R], *, anew: R | None = None) -> Changed[R]:
        """Apply `change` to the record and write the result; after a `Conflict`, read the document again and repeat.

        If `change` returns an equal record, nothing is written. AWS calls: two; one if nothing is written. Raises
        `RetryLater` after `TRIES` conflicts. If the document cannot be read as such a record, this raises ValueError
        and writes nothing. With `anew`, which is for data that can be rebuilt, `change` is applied to
        `anew` instead, and the result replaces the document.
        """
        for _ in range(TRIES):
            document = self._documents.get(key)
            before, unreadable = kind(), False
            if document:
                try:
                    before = from_json(document.body, kind)
                except ValueError as error:
                    if anew is None:
                        raise
                    before, unreadable = anew, True
                    failure("a document cannot be read and is made anew", error, kind=kind.__name__)
            after = change(before)
            if after == before and not unreadable:
                return Changed(before, after)
            try:
                if document:
                    self._documents.replace(key, to_json(after), document.etag)
                else:
                    self._documents.create(key, to_json(after))
            except Conflict:
                continue
            return Changed(before, after)
        raise RetryLater("the document keeps changing")
