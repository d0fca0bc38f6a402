"""The tape of one game step: what was said, and the calls of language models, stored within two seconds.

Recordings reach the store at the end of an episode; what is on the tape is there before the next server needs it. Its
pieces are `{step}-talk-0001.json` and so on, beside the server's recordings, each created once.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from functools import partial
from itertools import count
from typing import Any

from hippodrome.protocol.keys import tape_key
from hippodrome.trial.recordings.resume import earlier_servers
from hippodrome.trial.recordings.store import Store, retry_forever
from hippodrome.trial.settings import TrialSettings

SCHEMA = 1
WRITE_SECONDS = 2.0
"""A record is in the store so many seconds after it was added, unless the store does not answer."""
SLOWER_AFTER = 500
"""After so many pieces, which are 17 minutes of talk without a pause, it takes two seconds more, and so on: a server
may store 6,000 documents (`control/servers/signing.py`), which are then enough for 22 hours."""
_AT_ONCE = 20  # pieces that are read at the same time


class Tape:
    """Stores the records of one game step, and has those of earlier servers. For the event loop, but for `add`."""

    def __init__(self, settings: TrialSettings, step: str, store: Store, *, kept: bool = True) -> None:
        """`kept`: whether the records are stored; if not, they are lost with the server, as its recordings are."""
        self.earlier: list[dict[str, Any]] = []
        """The records of earlier servers, in order, after `load`."""
        self.seats: tuple[str, ...] = ()
        """In a session: the players, in the order of the seats."""
        self._settings = settings
        self._step = step
        self._store = store
        self._kept = kept
        self._loop = asyncio.get_running_loop()
        self._adding = threading.Lock()
        self._waiting: list[dict[str, Any]] = []
        self._number = 0  # of the last piece
        self._timer: asyncio.TimerHandle | None = None
        self._writing: asyncio.Task[None] | None = None

    async def load(self) -> None:
        """Read the records of earlier servers. Raises the store's errors, and ValueError."""
        folder, _, server = self._settings.recordings_folder.rpartition("/")
        self.earlier = await asyncio.to_thread(_read, self._store, folder, server, self._step)

    def add(self, record: dict[str, Any]) -> None:
        """Add a record, with the time if it has none. For any thread."""
        if not self._kept:
            return
        stamp = {"time": datetime.now(UTC).isoformat(timespec="microseconds"), "ns": time.monotonic_ns()}
        with self._adding:
            self._waiting.append({**stamp, **record})
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._added)

    @property
    def storing(self) -> bool:
        """Whether a record is not stored yet."""
        return bool(self._waiting) or (self._writing is not None and not self._writing.done())

    async def stored(self) -> None:
        """Store all records now, and wait until they are."""
        while self.storing:
            self._write()
            assert self._writing is not None
            await asyncio.wait({self._writing})

    def _added(self) -> None:
        if self._timer is None and self._waiting:
            pause = WRITE_SECONDS * (1 + self._number // SLOWER_AFTER)
            self._timer = self._loop.call_later(pause, self._write)

    def _write(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        if self._writing is None or self._writing.done():
            self._writing = asyncio.create_task(self._write_all())

    async def _write_all(self) -> None:
        while self._waiting:
            with self._adding:
                records, self._waiting = self._waiting, []
            piece = {"schema": SCHEMA, **({"seats": list(self.seats)} if self.seats else {}), "records": records}
            body = json.dumps(piece, separators=(",", ":"), default=str).encode()
            created = False
            while not created:  # a piece may be of an earlier process of this server
                self._number += 1
                key = tape_key(self._settings.recordings_folder, self._step, self._number)
                attempt = partial(asyncio.to_thread, self._store.create, key, body)
                created = await retry_forever("store what was said", attempt)


def _read(store: Store, folder: str, server: str, step: str) -> list[dict[str, Any]]:
    with ThreadPoolExecutor(_AT_ONCE) as threads:
        return [
            record
            for name in earlier_servers(server)
            for body in _pieces(threads, store, f"{folder}/{name}", step)
            for record in _records(body)
        ]


def _pieces(threads: ThreadPoolExecutor, store: Store, folder: str, step: str) -> Iterator[bytes]:
    """Yield the pieces of one server's tape, in order."""
    for first in count(1, _AT_ONCE):
        keys = [tape_key(folder, step, number) for number in range(first, first + _AT_ONCE)]
        bodies = list(threads.map(store.get, keys)) if first > 1 or store.get(keys[0]) is not None else [None]
        for body in bodies:
            if body is None:
                return
            yield body


def _records(body: bytes) -> list[dict[str, Any]]:
    piece = json.loads(body)
    if piece.get("schema") != SCHEMA:
        raise ValueError("the tape has a schema that this version cannot read")
    return list(piece["records"])
