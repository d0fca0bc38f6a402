"""Fixtures that let a bot play an example to the end, and that load an example's modules."""

from __future__ import annotations

import asyncio
import importlib.util
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from types import ModuleType
from typing import Any

import pytest
import yaml

from hippodrome.bots.bot import Bot
from hippodrome.local.new import LEFT_OUT
from hippodrome.local.rehearsal.logs import verify
from hippodrome.local.rehearsal.study_process import wait_until_gone
from hippodrome.trial.recordings.recording import read
from testing.held_study import HeldStudy
from testing.processes import ROOT

EXAMPLES = ROOT / "examples"
PATIENCE = 120.0  # seconds within which a bot must finish the study

PlayExample = Callable[..., "Played"]
LoadModule = Callable[[str, str], ModuleType]


@dataclass(frozen=True)
class Played:
    """A participant's recordings, each as its lines, and the result of the game."""

    recordings: list[list[dict[str, Any]]]
    result: Mapping[str, Any]

    def steps(self) -> list[dict[str, Any]]:
        """Return the steps of all episodes."""
        return [line for lines in self.recordings for line in lines if line["kind"] == "step"]


@pytest.fixture
def play_example(tmp_path: Path) -> Iterator[PlayExample]:
    """Let a bot play an example to the end: `play_example("tamer", maxEpisodes=1)` sets these keys of `trial`.

    Fails if the bot does not come to the end, or if an answer, a recording or a server is missing or left over.
    """
    held: list[HeldStudy] = []

    def play(name: str, **trial: Any) -> Played:
        folder = tmp_path / name
        shutil.copytree(EXAMPLES / name, folder, ignore=LEFT_OUT)
        config = yaml.safe_load((folder / "config.yml").read_text())
        config["trial"] |= trial
        (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False))
        study = HeldStudy(folder, tmp_path / "run" / "data", log=tmp_path / "local.log")
        held.append(study)
        study.start()
        bot = Bot(study.link, "ada", Random(name), play=0, patience=PATIENCE)
        asyncio.run(asyncio.wait_for(bot.run(), PATIENCE))
        report, project = bot.report, config["project"]["id"]
        assert (report.errors, report.troubles, report.finished) == ([], [], True)
        assert verify(study.data, project, [report]).missing == []
        assert wait_until_gone(study.data).words() == []
        assert study.interrupt()
        files = sorted((study.data / project / "users" / "ada" / "trials").glob("*/*.gz"))
        return Played([list(read(file.read_bytes())) for file in files], vars(report.plays[-1]))

    yield play
    for study in held:
        study.clear()


@pytest.fixture
def load_module(monkeypatch: pytest.MonkeyPatch) -> Iterator[LoadModule]:
    """Load a module of an example: `load_module("tamer", "agent")`. After the test, the example's modules are forgotten."""
    before = set(sys.modules)

    def load(name: str, module: str) -> ModuleType:
        folder = EXAMPLES / name
        monkeypatch.syspath_prepend(str(folder))
        spec = importlib.util.spec_from_file_location(module, folder / f"{module}.py")
        assert spec is not None
        assert spec.loader is not None
        loaded = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, module, loaded)
        spec.loader.exec_module(loaded)
        return loaded

    yield load
    for name, module in list(sys.modules.items()):
        if name not in before and str(getattr(module, "__file__", "")).startswith(f"{EXAMPLES}/"):
            del sys.modules[name]
