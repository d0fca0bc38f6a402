"""Images assembled without Docker: pushed to a real registry, pulled, and run as on Fargate, until a bot has played."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import json
import os
import re
import shutil
import ssl
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from hippodrome.bots.bot import SUBPROTOCOL
from hippodrome.bots.game import GameConnection
from hippodrome.bots.report import BotReport, PlayedStep
from hippodrome.console.problem import Problem
from hippodrome.deployment.code import bytecode
from hippodrome.deployment.study.image import assembled, builders, packages
from hippodrome.deployment.study.image.bundle import make_bundle
from hippodrome.deployment.study.image.order import Order
from hippodrome.deployment.study.image.registry import Repository
from testing import ports
from tests.certificate import addresses, pebble
from tests.deployment import sandbox

ROOT = Path(__file__).resolve().parents[3]
pytestmark = pytest.mark.timeout(600)  # making a base takes a minute, or several on a busy machine
STUDY = "ecr/hippodrome"  # the repository of the images


@dataclass(frozen=True)
class Images:
    """A registry, with the names of bases there."""

    address: str
    folder: Path
    bases: Mapping[str, str]

    def order(self, study: Path, base: str, tag: str, **options: Any) -> Order:
        bundle = make_bundle(study, self.bases[base], {"game": "ALE/MsPacman-v5"})
        repository: Any = SimpleNamespace(
            uri=f"{self.address}/{STUDY}",
            registry=self.address,
            address=f"http://{self.address}",
            name=STUDY,
            password=lambda: "",
        )
        return Order(repository, tag, tag, bundle, **options)


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Images]:
    """A registry of this machine with bases in both layouts, and a cache of our own."""
    if lacking := sandbox.missing():
        assert not os.environ.get("REQUIRE_IMAGES"), lacking
        pytest.skip(lacking)
    folder = tmp_path_factory.mktemp("images")
    with sandbox.registry(folder / "registry", ports.free()) as address:
        bases = {
            "Debian's layout": sandbox.push_debian(address, "debian/python", folder),
            "the official layout": sandbox.push_official(address, "docker/library/python", folder),
        }
        yield Images(address, folder, bases)


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """An empty cache of layers and packages."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("cache")
        patch.setattr(assembled, "cache_folder", lambda: folder)
        yield folder


@pytest.fixture
def study(tmp_path: Path) -> Path:
    """The first example."""
    folder = tmp_path / "study"
    folder.mkdir()
    for name in ("agent.py", "config.yml"):
        shutil.copy(ROOT / name, folder / name)
    return folder


@pytest.fixture
def root() -> Iterator[Path]:
    """A place for an unpacked image: its user may pass, as pytest's own folders are for root alone."""
    with tempfile.TemporaryDirectory(prefix="image-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder, "root")


@pytest.mark.parametrize("base", ["Debian's layout", "the official layout"])
def test_an_assembled_image_plays_as_its_user_with_a_read_only_root(
    images: Images, study: Path, root: Path, tmp_path: Path, base: str, capsys: pytest.CaptureFixture[str]
) -> None:
    tag = re.sub(r"\W", "-", base)
    assembled.build(images.order(study, base, tag))
    told = capsys.readouterr().err
    assert "The agent was tried" in told or "The agent was not tried" in told
    config = sandbox.unpack(images.address, STUDY, tag, root)
    assert config["Cmd"] == ["python", "-m", "hippodrome.trial"]
    assert (root / "scratch").stat().st_uid == 10001
    play = played(root, config, tmp_path)
    assert play.done
    assert play.frames > 30
    status = sandbox.inside(root, config, ["cat", "/proc/self/status"], tmp_path / "status")
    assert re.search(r"Uid:\t10001\t10001", status)
    assert re.search(r"CapEff:\t0+\nCapBnd:\t0+\n", status)
    for place in ("/project/x", "/hippodrome/x", "/tmp/x"):
        refused = sandbox.start(root, {**config, "Cmd": ["touch", place]}, {}, tmp_path / "touch")
        assert refused.wait(60) != 0, place


def test_an_assembled_image_gets_a_certificate_for_its_address_and_plays_over_tls(
    images: Images, study: Path, root: Path, tmp_path: Path
) -> None:
    """Without a domain: the image's user makes a key, answers the authority, and a client checks the address."""
    if not pebble.installed():
        assert not os.environ.get("REQUIRE_PEBBLE"), pebble.MISSING
        pytest.skip(pebble.MISSING)
    assembled.build(images.order(study, "the official layout", "certified"))
    config = sandbox.unpack(images.address, STUDY, "certified", root)
    with pebble.running(tmp_path) as authority, addresses.served(authority) as installation:
        record = installation.server()
        variables = {
            "SERVER": record.name, "USER_ID": record.user_id, "CREDENTIAL": installation.credential(record),
            "CERTIFICATE": installation.url, "TLS": "",
        }  # fmt: skip
        program = CHALLENGED.replace("PORT", str(authority.http_port))
        config = {**config, "Cmd": ["python", "-c", program]}
        play = played(root, config, tmp_path, variables, ssl.create_default_context(cadata=authority.root()))
        assert installation.ready
        assert installation.orders == 1
    assert play.done
    assert play.frames > 30


CHALLENGED = """
from hippodrome.trial.server import own_certificate
own_certificate.Order.__init__.__defaults__ = (PORT,)  # where the tests' authority looks, instead of port 80
from hippodrome.trial.__main__ import main
raise SystemExit(main())
"""


def played(
    root: Path,
    config: Mapping[str, Any],
    folder: Path,
    more: Mapping[str, str] | None = None,
    tls: ssl.SSLContext | None = None,
) -> PlayedStep:
    """Let a bot play the image's game for two seconds, then stop it; the server then ends by itself.

    `more` are further variables of the server; with `tls` the bot connects by TLS, and checks its certificate.
    """
    section = yaml.safe_load((ROOT / "config.yml").read_text())["trial"]
    variables = {
        "PROJECT_ID": "maze", "USER_ID": "P1", "SERVER": "s-1", "TOKEN": "secret", "GAME_STEPS": "3", "GROUP": "",
        "TRIAL": json.dumps(section), "HOST": "127.0.0.1", "PORT": "0", "TLS": "off", "STORE": "/scratch/store",
        "LINGER_SECONDS": "0.2", **(more or {}),
    }  # fmt: skip
    log, errors = folder / "log", folder / "log.err"
    process = sandbox.start(root, config, variables, log)
    try:
        while b"\n" not in log.read_bytes():
            assert process.poll() is None, errors.read_text()
            time.sleep(0.05)
        port = json.loads(log.read_text().splitlines()[0])["port"]
        play = PlayedStep("3")
        asyncio.run(_play(port, play, variables, tls))
        assert process.wait(60) == 0, errors.read_text()
    finally:
        process.kill()
        process.wait()
    return play


def test_an_image_that_buildah_builds_plays_likewise(
    images: Images, study: Path, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if lacking := sandbox.missing("buildah"):
        assert not os.environ.get("REQUIRE_IMAGES"), lacking
        pytest.skip(lacking)
    for name, value in sandbox.buildahs_settings(tmp_path / "buildah", images.address).items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(builders, "BUILDERS", [each for each in builders.BUILDERS if each.program == "buildah"])
    monkeypatch.setattr(builders, "_login", lambda *_: None)  # buildah logs in by TLS alone
    builders.build(images.order(study, "the official layout", "built"))
    config = sandbox.unpack(images.address, STUDY, "built", root)
    play = played(root, config, tmp_path)
    assert play.done
    assert play.frames > 30


def test_a_changed_agent_is_all_that_is_sent(images: Images, study: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assembled.build(images.order(study, "Debian's layout", "first"))
    (study / "agent.py").write_text((study / "agent.py").read_text() + "\n# changed\n")
    capsys.readouterr()
    assembled.build(images.order(study, "Debian's layout", "second"))
    told = capsys.readouterr().err
    sent = [line.split()[0:2] for line in told.splitlines() if line.endswith("  sent")]
    assert sent == [["the", "study"]]
    assert told.count("  there already") == 3, "the base, the packages and Hippodrome"


def test_the_same_study_makes_the_same_image_on_another_machine(images: Images, study: Path, tmp_path: Path) -> None:
    assembled.build(images.order(study, "the official layout", "here"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(assembled, "cache_folder", lambda: tmp_path)
        assembled.build(images.order(study, "the official layout", "there"))
    here, there = (Repository(f"http://{images.address}", STUDY).manifest(tag)[0] for tag in ("here", "there"))
    assert here == there


def test_our_layers_are_small(images: Images, study: Path, cache: Path) -> None:
    """Each server pulls them before its participant can play."""
    assembled.build(images.order(study, "Debian's layout", "small"))
    _, manifest = Repository(f"http://{images.address}", STUDY).manifest("small")
    assert sum(layer["size"] for layer in manifest["layers"][1:]) <= 31_000_000


def test_an_agent_that_lacks_a_package_is_not_sent(images: Images, study: Path) -> None:
    """The machine's own Python has it; the image has not."""
    if bytecode.compiler(packages.PYTHON) is None:
        pytest.skip("The agent is tried only where Python 3.13 is installed")
    (study / "agent.py").write_text("import psutil\n\n\nclass Agent:\n    pass\n")
    with pytest.raises(Problem, match=r"The image would lack something: agent\.py:1: ModuleNotFoundError"):
        assembled.build(images.order(study, "Debian's layout", "lacking"))
    with pytest.raises(Problem, match="refused a request"):
        Repository(f"http://{images.address}", STUDY).manifest("lacking")


def test_another_kind_of_machine_says_that_it_could_not_try(
    images: Images, study: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("platform.machine", lambda: "arm64")
    assembled.build(images.order(study, "Debian's layout", "untried"))
    assert "! The agent was not tried with the image's packages: that needs Python 3.13" in capsys.readouterr().err


def test_a_base_with_another_python_is_refused(images: Images, study: Path) -> None:
    folder = images.folder / "old"
    folder.mkdir()
    old = sandbox.push_official(images.address, "old/python", folder, version="3.12.1")
    bundle = make_bundle(study, old)
    order = images.order(study, "Debian's layout", "old")
    with pytest.raises(Problem, match=r"has Python 3\.12\.1, and the trial needs Python 3\.13"):
        assembled.build(dataclasses.replace(order, bundle=bundle))


async def _play(port: int, play: PlayedStep, variables: Mapping[str, str], tls: ssl.SSLContext | None) -> None:
    report, user_id = BotReport("P1"), variables["USER_ID"]
    options: dict[str, Any] = {"max_size": None, "subprotocols": [SUBPROTOCOL], "compression": None, "proxy": None}
    async with connect(f"{'wss' if tls else 'ws'}://127.0.0.1:{port}/", ssl=tls, **options) as websocket:
        bot = GameConnection(websocket, play, report, Random(1), 2)
        with contextlib.suppress(ConnectionClosed):
            await bot.run({"userId": user_id, "token": "secret", "step": "3"})
    assert not report.troubles
