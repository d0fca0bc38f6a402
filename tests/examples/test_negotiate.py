"""examples/negotiate: bots play both of its studies to the end, and the guide tells what was offered."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

from hippodrome.bots.bot import Bot
from hippodrome.control.config import read_project
from hippodrome.control.model.design import cell_name, cells
from hippodrome.local.new import LEFT_OUT
from hippodrome.local.rehearsal.logs import verify
from testing.held_study import HeldStudy
from testing.processes import ROOT

EXAMPLE = ROOT / "examples" / "negotiate"
PATIENCE = 120.0  # seconds within which all bots must finish the study


def study_of(file: str, folder: Path, **trial: Any) -> Path:
    """Copy the example with this config, and these keys of `trial`."""
    shutil.copytree(EXAMPLE, folder, ignore=LEFT_OUT)
    config = yaml.safe_load((EXAMPLE / file).read_text(encoding="utf-8"))
    config["trial"] |= trial
    (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    return folder


@pytest.mark.parametrize(("file", "names"), [("config.yml", ("ada", "bo")), ("with-a-model.yml", ("ada",))])
def test_bots_come_to_the_end(file: str, names: tuple[str, ...], tmp_path: Path) -> None:
    folder = study_of(file, tmp_path / "negotiate", maxEpisodes=2, episodeSeconds=2)
    study = HeldStudy(folder, tmp_path / "run" / "data", log=tmp_path / "local.log")
    try:
        study.start()
        bots = [Bot(study.link, name, Random(name), play=0, patience=PATIENCE) for name in names]

        async def walk() -> list[Any]:
            return list(await asyncio.wait_for(asyncio.gather(*(bot.run() for bot in bots)), PATIENCE))

        reports = asyncio.run(walk())
        assert [(each.errors, each.troubles, each.finished) for each in reports] == [([], [], True)] * len(names)
        project = read_project(folder).project.id
        assert verify(study.data, project, reports).missing == []
    finally:
        study.clear()


def test_half_of_the_participants_meet_each_persona(tmp_path: Path) -> None:
    design = read_project(study_of("with-a-model.yml", tmp_path / "negotiate")).design
    assert [cell_name(levels) for levels in cells(design.conditions)] == ["warm", "firm"]


def test_the_guide_says_who_is_who_in_private_and_what_was_offered_once_both_have_written_it(load_module: Any) -> None:
    said: list[tuple[str, str | None]] = []
    noted: list[Any] = []
    session = SimpleNamespace(
        players=("buyer", "seller"),
        episode=1,
        say=lambda text, to=None: said.append((text, to)),
        record=lambda *noted_now: noted.append(noted_now),
    )
    agent = load_module("negotiate", "agent").Agent()
    agent.on_episode_start(session)
    assert [(to, to in text) for text, to in said] == [("buyer", True), ("seller", True)]
    agent.on_form(session, "buyer", {"price": "70"})
    assert len(said) == 2
    agent.on_form(session, "seller", {"price": "90"})
    assert said[2:] == [("The buyer offers 70, and the seller asks for 90.", None)]
    assert noted == [("offers", {"buyer": "70", "seller": "90"})]
