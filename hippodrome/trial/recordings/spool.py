"""The folder where recordings are written, and their way into the store: no recording is lost or overwritten."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import tempfile
from collections.abc import Awaitable, Callable
from functools import partial
from itertools import count
from pathlib import Path
from typing import TypeVar

from hippodrome.protocol.keys import with_number
from hippodrome.trial.recordings.recording import Recording
from hippodrome.trial.recordings.store import FolderStore, Store, short_error
from hippodrome.trial.settings import TrialSettings

T = TypeVar("T")
log = logging.getLogger("trial")

_MAX_PAUSE = 20.0  # the longest pause, in seconds


class Spool:
    """The folder where recordings are written before they are stored: SPOOL, the store's folder, or a temporary one."""

    def __init__(self, settings: TrialSettings, store: Store) -> None:
        self.local_only = not settings.trial.s3upload
        if settings.spool is not None:
            self.folder = settings.spool
        elif isinstance(store, FolderStore) and not self.local_only:
            self.folder = store.folder
        else:
            self.folder = Path(tempfile.mkdtemp(prefix="trial-"))

    def open(self, key: str) -> Recording:
        """Open a new recording for this key; for the key with a number if the key has a recording. Raises OSError."""
        for number in range(1, 100):
            numbered = with_number(key, number)
            path = self.folder / f"{numbered}.part"
            if (self.folder / numbered).exists():
                continue
            with contextlib.suppress(FileExistsError):
                return Recording(path, numbered)
        raise FileExistsError(key)

    def leftovers(self, prefix: str) -> list[tuple[str, Path]]:
        """Return the recordings with this prefix that a killed process has left here: their keys and paths.

        Those in which nothing was written are deleted.
        """
        leftovers = []
        for path in sorted((self.folder / prefix).glob("*.jsonl.gz.part")):
            if path.stat().st_size == 0:  # the disk was full, or the process was killed in its first half second
                path.unlink()
            else:
                leftovers.append((f"{prefix}/{path.name.removesuffix('.part')}", path))
        return leftovers


async def store_file(store: Store, key: str, path: Path) -> None:
    """Store a closed recording under its key, or under the key with a number if that exists; then delete the file.

    After an error it tries again, without a limit.
    """
    for number in count(1):
        attempt = partial(asyncio.to_thread, store.create, with_number(key, number), path)
        if await retry_forever("store a recording", attempt):
            break
    path.unlink(missing_ok=True)


async def retry_forever(action: str, attempt: Callable[[], Awaitable[T]]) -> T:
    """Call `attempt` until it succeeds, with growing pauses, and return its result. The log says "cannot `action`"."""
    pause = 0.5
    while True:
        try:
            return await attempt()
        except Exception as error:  # noqa: BLE001 - whatever the store raises, the data must not be lost
            log.warning("cannot %s (%s); trying again in %g s", action, short_error(error), pause)
        await asyncio.sleep(pause)
        pause = min(2 * pause, _MAX_PAUSE)
