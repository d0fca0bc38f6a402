"""Images assembled without Docker: pushed to a real registry, pulled, and run as on Fargate, until a bot has played."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
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
from hippodrome.deployment.study.image import assembled
from hippodrome.deployment.study.image.bundle import make_bundle
from hippodrome.deployment.study.image.order import Order
from testing import ports
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
        repository: Any = SimpleNamespace(address=f"http://{self.address}", name=STUDY, password=lambda: "")
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


def played(root: Path, config: Mapping[str, Any], folder: Path) -> PlayedStep:
    """Let a bot play the image's game for two seconds, then stop it; the server then ends by itself."""
    section = yaml.safe_load((ROOT / "config.yml").read_text())["trial"]
    variables = {
        "PROJECT_ID": "maze", "USER_ID": "P1", "SERVER": "s-1", "TOKEN": "secret", "GAME_STEPS": "3", "GROUP": "",
        "TRIAL": json.dumps(section), "HOST": "127.0.0.1", "PORT": "0", "TLS": "off", "STORE": "/scratch/store",
        "LINGER_SECONDS": "0.2",
    }  # fmt: skip
    log, errors = folder / "log", folder / "log.err"
    process = sandbox.start(root, config, variables, log)
    try:
        while b"\n" not in log.read_bytes():
            assert process.poll() is None, errors.read_text()
            time.sleep(0.05)
        port = json.loads(log.read_text().splitlines()[0])["port"]
        play = PlayedStep("3")
        asyncio.run(_play(port, play))
        assert process.wait(60) == 0, errors.read_text()
    finally:
        process.kill()
        process.wait()
    return play


async def _play(port: int, play: PlayedStep) -> None:
    report = BotReport("P1")
    options: dict[str, Any] = {"max_size": None, "subprotocols": [SUBPROTOCOL], "compression": None, "proxy": None}
    async with connect(f"ws://127.0.0.1:{port}/", **options) as websocket:
        bot = GameConnection(websocket, play, report, Random(1), 2)
        with contextlib.suppress(ConnectionClosed):
            await bot.run({"userId": "P1", "token": "secret", "step": "3"})
    assert not report.troubles
