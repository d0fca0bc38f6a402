"""docs/first-hour.md, walked on ministack: the real Makefile, commands, template and functions; two Pebbles for Let's Encrypt.

It has an account and an emulator of its own, which are empty before and after. Its commands are typed into a shell as the page
has them, in its order; those for which servers have to run are in `tests/deployment/test_first_hour.py`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator

import httpx
import pytest

from testing.ministack.world import MinistackWorld
from tests import first_hour
from tests.certificate import pebble
from tests.ministack.conftest import emulated
from tests.ministack.newcomer import DOMAIN, Newcomer, arrived

pytestmark = [pytest.mark.timeout(300)]

DEPLOY = "make deploy EMAIL=you@example.org"
WITH_DOMAIN = f"make deploy DOMAIN={DOMAIN} EMAIL=you@example.org"
BEFORE = ("make doctor", "make plan EMAIL=you@example.org", "make cost")
STANDING = (DEPLOY, 'make doctor ARGS="--at-once 2"')
DRAINING = ("make stop", "make destroy")


@pytest.fixture(scope="module")
def newcomer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Newcomer]:
    if not pebble.installed():
        assert not os.environ.get("REQUIRE_PEBBLE"), pebble.MISSING
        pytest.skip(pebble.MISSING)
    home = tmp_path_factory.mktemp("newcomer")
    (home / "world").mkdir()
    with MinistackWorld(emulated(), home / "world") as world, arrived(world, home / "arrived") as made:
        yield made


@pytest.fixture(scope="module")
def empty(newcomer: Newcomer) -> dict[str, list[str]]:
    return newcomer.world.inventory()


FAILURES = (
    ("env -u AWS_ACCESS_KEY_ID -u AWS_SECRET_ACCESS_KEY {plan}", "There are no AWS credentials on this machine."),
    ("AWS_REGION= {plan}", "No AWS region is set."),
    ("AWS_ACCESS_KEY_ID=AKIAWRONG {plan}", "AWS does not accept these credentials."),
    ("make plan DOMAIN=lab.example.net", "This account has no public hosted zone for …"),
    (
        "AWS_REGION=me-south-1 {deploy}",
        "region: Hippodrome cannot be installed in …: not every service that it needs is there.",
    ),
    ("make status", "There is no stack named … in …"),
)
NOTHING_LIVE = "No live project has a game: there is nothing to start."
NO_SERVERS = "domain: The Internet knows no name servers for … No certificate can be issued for it, and its names cannot be resolved."
OF_DNS = (
    ((DOMAIN, "NS"), (), NO_SERVERS),
    ((DOMAIN, "NS"), ("ns.elsewhere.net.",), "domain: … is delegated to other name servers: …"),
    (
        (DOMAIN, "CAA"),
        ('0 issue "digicert.com"',),
        "CAA: The CAA records of … keep … from issuing a certificate for …",
    ),
)


@pytest.mark.parametrize(("record", "values", "message"), OF_DNS, ids=[message for *_, message in OF_DNS])
def test_problems_of_dns_are_reported_in_the_words_of_the_page(
    newcomer: Newcomer,
    empty: dict[str, list[str]],
    monkeypatch: pytest.MonkeyPatch,
    record: tuple[str, str],
    values: tuple[str, ...],
    message: str,
) -> None:
    monkeypatch.setitem(newcomer.internet, record, values)
    refused(newcomer, WITH_DOMAIN, message)
    assert newcomer.world.inventory() == empty, "nothing was made"


def refused(newcomer: Newcomer, line: str, message: str) -> None:
    """Run a command that fails; check its last lines: this message of the page, and a remedy below it."""
    assert message in first_hour.failures()
    code, printed = newcomer.types(line)
    assert code, printed
    said = ".*".join(map(re.escape, message.split(first_hour.GAP)))
    assert re.search(rf"✗ ([a-z]+: )?{said}.*\n\s*→ ", printed), printed


@pytest.mark.parametrize(("line", "message"), FAILURES, ids=[message for _, message in FAILURES])
def test_problems_are_reported_in_the_words_of_the_page(
    newcomer: Newcomer, empty: dict[str, list[str]], line: str, message: str
) -> None:
    refused(newcomer, line.format(plan=BEFORE[1], deploy=DEPLOY), message)
    assert newcomer.world.inventory() == empty, "nothing was made"


def types(newcomer: Newcomer, command: str, exit_code: int = 0, answer: str = "") -> None:
    """Run a command of the page, and check that it prints what the page shows."""
    code, printed = newcomer.types(command, answer=answer)
    assert code == exit_code, printed
    assert first_hour.differs(first_hour.shown()[command], printed) == "", printed


@pytest.mark.parametrize("command", BEFORE)
def test_commands_before_the_installation_print_what_the_page_shows(
    newcomer: Newcomer, empty: dict[str, list[str]], command: str
) -> None:
    types(newcomer, command, exit_code=2 if command == "make doctor" else 0)
    assert newcomer.world.inventory() == empty


@pytest.mark.parametrize("command", STANDING)
def test_deploy_prints_what_the_page_shows(newcomer: Newcomer, command: str) -> None:
    types(newcomer, command)


def test_the_printed_link_opens_the_study(newcomer: Newcomer) -> None:
    (stack,) = newcomer.world.client("cloudformation").describe_stacks(StackName="hippodrome")["Stacks"]
    (address,) = [output["OutputValue"] for output in stack["Outputs"] if output["OutputKey"] == "Site"]
    assert ".execute-api." in address, "AWS's own address: the newcomer has no domain"
    site = httpx.URL(f"{address}/next?projectId=ms-pacman")
    host = f"{site.host.partition('.')[0]}.execute-api.localhost"  # where the emulator serves the API
    with httpx.Client(headers={"Host": host, "Accept": "text/html"}, verify=newcomer.world.tls) as browser:
        page = browser.get(f"{newcomer.world.endpoint}{site.raw_path.decode()}&userId=me", timeout=60)
    assert (page.status_code, "consent" in page.text) == (200, True)


def test_without_a_live_study_there_is_nothing_to_rehearse(newcomer: Newcomer) -> None:
    assert newcomer.types("make register ARGS=--no-live")[0] == 0
    refused(newcomer, "make doctor ARGS=--rehearse", NOTHING_LIVE)
    assert newcomer.types("make register ARGS=--live")[0] == 0


def test_deploying_again_changes_nothing(newcomer: Newcomer) -> None:
    code, printed = newcomer.types(DEPLOY)
    assert code == 0, printed
    assert "Nothing to do: the stack hippodrome" in printed
    assert "there already" in printed


@pytest.mark.parametrize("command", DRAINING)
def test_destroy_prints_what_the_page_shows(newcomer: Newcomer, command: str) -> None:
    types(newcomer, command, answer="hippodrome" if command == "make destroy" else "")


def test_only_the_data_are_left(newcomer: Newcomer, empty: dict[str, list[str]]) -> None:
    left = {kind: set(names) - set(empty[kind]) for kind, names in newcomer.world.inventory().items()}
    (bucket,) = left.pop("buckets")
    assert bucket.startswith("hippodrome-bucket-")
    assert {kind: names for kind, names in left.items() if names} == {}
