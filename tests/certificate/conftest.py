"""A certificate authority for a run of tests, and a place to store what it issues."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import acme.client
import pytest

from hippodrome.control.certificates import rules as certificate
from hippodrome.control.certificates.renewal import Renewal, RenewalOutcome
from hippodrome.control.certificates.rules import ACCOUNT, CertificateRecord, OrderStage, RenewalRequest
from hippodrome.control.ports import Documents
from hippodrome.local.backend.documents import FolderDocuments
from testing.moto_world import moto_world  # noqa: F401 - a fixture
from tests.certificate.pebble import MISSING, Pebble, TestChallenges, installed, running

ROOT_DOMAIN = "example.org"
DOMAIN = f"servers.{ROOT_DOMAIN}"
PLACE = certificate.location(DOMAIN)
FULLCHAIN, PRIVKEY, STATE = PLACE


@pytest.fixture(scope="session", autouse=True)
def no_proxy() -> None:
    """Loopback is reached without a proxy, whatever the environment says."""
    os.environ["NO_PROXY"] = os.environ["no_proxy"] = "127.0.0.1,localhost"


def _pebble(tmp_path_factory: pytest.TempPathFactory, **how: timedelta) -> Iterator[Pebble]:
    if not installed():
        assert not os.environ.get("REQUIRE_PEBBLE"), MISSING
        pytest.skip(MISSING)
    with running(tmp_path_factory.mktemp("pebble"), **how) as pebble:
        yield pebble


@pytest.fixture(scope="session")
def pebble(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pebble]:
    """An authority that issues certificates for 90 days, as Let's Encrypt does until February 2027."""
    yield from _pebble(tmp_path_factory)


@pytest.fixture(scope="session")
def second_pebble(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Pebble]:
    """Another authority, which issues certificates for 160 hours, as Let's Encrypt's profile `shortlived` does."""
    yield from _pebble(tmp_path_factory, lifetime=timedelta(hours=160))


@pytest.fixture(autouse=True)
def poll_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """`acme` asks the authority once a second whether it is done; here it asks twenty times a second."""
    monkeypatch.setattr(acme.client, "time", SimpleNamespace(sleep=lambda s: time.sleep(min(s, 0.05))))


class Place:
    """An installation's bucket as a folder, its challenges, and a clock that can be moved."""

    def __init__(self, folder: Path, pebble: Pebble) -> None:
        self.folder = folder / "bucket"
        self.pebble = pebble
        self.documents = FolderDocuments(self.folder, folder / "state")
        self.challenges = TestChallenges(pebble)
        self.ahead = timedelta(0)
        self.stages: list[OrderStage] = []
        self.notes: list[str] = []

    def now(self) -> datetime:
        return datetime.now(UTC) + self.ahead

    def renewal(
        self,
        documents: Documents | None = None,
        tell: Callable[[OrderStage], None] | None = None,
        at: certificate.Location = PLACE,
    ) -> Renewal:
        return Renewal(
            documents or self.documents,
            self.challenges,
            self.now,
            at,
            tell=tell or self.stages.append,
            note=lambda text, error: self.notes.append(text),
        )

    def wish(self, pebble: Pebble | None = None, **more: object) -> RenewalRequest:
        where = pebble or self.pebble
        return RenewalRequest(
            **{"domain": DOMAIN, "directory": where.directory, "trusted": where.trusted, "seconds": 60.0, **more}
        )  # type: ignore[arg-type]

    def lose_account(self) -> None:
        """Remove the account, so that the next order must prove everything again.

        With the old account Pebble 2.4 sometimes accepts an earlier proof, although PEBBLE_AUTHZREUSE=0 forbids it."""
        (self.folder / ACCOUNT).unlink()

    def obtain(self, **more: object) -> RenewalOutcome:
        return self.renewal().obtain(self.wish(**more))  # type: ignore[arg-type]

    @property
    def state(self) -> CertificateRecord:
        return self.renewal().read()[0]

    def read(self, key: str) -> str:
        return (self.folder / key).read_text()

    @property
    def chain(self) -> str:
        return self.read(FULLCHAIN)

    @property
    def key(self) -> str:
        return self.read(PRIVKEY)


@pytest.fixture
def place(tmp_path: Path, pebble: Pebble) -> Place:
    return Place(tmp_path, pebble)
