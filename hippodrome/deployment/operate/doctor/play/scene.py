"""What the parts of a rehearsal share: the copy of the study, the bots' addresses, and waiting with progress texts."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from random import Random
from typing import TypeVar

from hippodrome.bots.addresses import OneSite
from hippodrome.bots.bot import Bot
from hippodrome.control.model.server import Server
from hippodrome.control.ports import Platform
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.operate.doctor.check_context import CheckContext, CheckFailed
from hippodrome.deployment.operate.doctor.play.copy import Copy
from hippodrome.deployment.operate.doctor.play.transcript import Transcript

PAUSE = 2.0  # seconds between two looks
BOT_PATIENCE = 420.0  # seconds that a bot waits for one event: the longest time of three attempts of a server
T = TypeVar("T")


@dataclass
class RehearsalContext:
    """The input of every part. When `time.monotonic()` is `until`, the rehearsal must end."""

    context: CheckContext
    copy: Copy
    where: OneSite
    transcript: Transcript
    progress: Callable[[str], None]
    until: float

    @property
    def platform(self) -> Platform:
        return self.context.platform

    @property
    def repository(self) -> Repository:
        return Repository(self.platform.documents)

    def left(self) -> float:
        """The seconds until the rehearsal must end."""
        return max(self.until - time.monotonic(), 0.0)

    def bot(self, name: str, play: float) -> Bot:
        """Make a bot with a signed link, which plays for `play` seconds. The transcript hides its id."""
        user = self.copy.user(name)
        self.transcript.hide(user)
        patience = min(BOT_PATIENCE, self.left())
        random = Random(user)  # noqa: S311 - for the keys that it presses
        return Bot(self.copy.link(user), user, random, play=play, patience=patience, allowed=self.where)

    def server(self, user: str) -> Server | None:
        """Read the record of a bot's server, or of its session's server. The transcript hides its token and names."""
        membership = self.repository.membership(self.copy.id, user) if self.copy.project.players > 1 else None
        server = self.repository.server_of(self.copy.id, (membership and membership.session) or user)
        if server is not None:
            self.transcript.hide(server.nonce, server.name, server.label, server.host, server.task)
        return server

    def wait(self, look: Callable[[], T | None], activity: str, seconds: float, failed: CheckFailed) -> T:
        """Call `look` until it returns a value, and return that. Raises `failed` after `seconds`, or at `until`."""
        began = time.monotonic()
        while (outcome := look()) is None:
            spent = time.monotonic() - began
            if spent > seconds or not self.left():
                raise failed
            self.progress(f"{activity}, {spent:.0f} s")
            time.sleep(PAUSE)
        return outcome
