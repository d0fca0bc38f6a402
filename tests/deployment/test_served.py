"""An account on moto that several threads and processes use at once, as `RunningInstallation` and commands as processes do."""

from __future__ import annotations

import http.client
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from urllib.parse import urlsplit

import pytest

from testing import moto_world
from testing.moto_world import MotoWorld
from tests.contract.backends import MotoBackend, name
from tests.deployment.installation import Installed

SIGNED = "AWS4-HMAC-SHA256 Credential=x/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0"
AT_ONCE = 8


@pytest.fixture
def restless_threads() -> Iterator[None]:
    """Let Python switch threads as often as possible."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


def at_once(act: Callable[[int], object]) -> None:
    """Let `AT_ONCE` threads call it with their numbers."""
    ready = threading.Barrier(AT_ONCE)

    def one(number: int) -> None:
        ready.wait()
        act(number)

    with ThreadPoolExecutor(AT_ONCE) as pool:
        list(pool.map(one, range(AT_ONCE)))


@pytest.mark.usefixtures("restless_threads")
def test_only_one_of_many_processes_creates_a_document(installed: Installed) -> None:
    with installed.served() as env:
        place = urlsplit(env["AWS_ENDPOINT_URL"])
        for document in range(20):
            statuses: list[int] = []

            def create(number: int, document: int = document, statuses: list[int] = statuses) -> None:
                link = http.client.HTTPConnection(str(place.hostname), place.port)
                headers = {"If-None-Match": "*", "Authorization": SIGNED}
                link.request("PUT", f"/{installed.env['BUCKET']}/{document}", b"%d" % number, headers)
                statuses.append(link.getresponse().status)
                link.close()

            at_once(create)
            assert sorted(statuses) == [200, *[412] * (AT_ONCE - 1)]


@pytest.mark.usefixtures("restless_threads")
def test_a_task_has_the_same_address_for_all_threads() -> None:
    with MotoWorld() as world:
        task = world.platform.tasks.run(MotoBackend(world).request(name()))
        found: list[str] = []
        at_once(lambda _: found.append(world.public_ip(task)))
        assert len(set(found)) == 1


def test_clients_of_threads_are_made_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """botocore's sessions are not thread-safe."""
    under_way, most = set[int](), 0

    class Session:
        def create_client(self, service: str, region_name: str) -> Any:
            nonlocal most
            under_way.add(threading.get_ident())
            most = max(most, len(under_way))
            time.sleep(0.01)
            under_way.remove(threading.get_ident())

    monkeypatch.setattr(moto_world, "_own_session", Session())
    worlds = [MotoWorld(region=f"nowhere-{number}") for number in range(AT_ONCE)]
    at_once(lambda number: worlds[number].client("s3"))
    assert most == 1
