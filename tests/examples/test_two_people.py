"""Examples, changed for two people by the lines in their README: two bots play them to the end."""

from __future__ import annotations

import asyncio
import re
import shutil
import textwrap
from pathlib import Path
from random import Random
from typing import Any

import pytest
import yaml

from hippodrome.bots.bot import Bot
from hippodrome.local.new import LEFT_OUT
from hippodrome.local.rehearsal.logs import verify
from hippodrome.trial.recordings.recording import read
from testing.held_study import HeldStudy
from testing.processes import ROOT

SHORT = {"maxEpisodes": 1, "resetFreeze": 0, "countdown": 1, "absent": 10}
PATIENCE = 150.0  # seconds within which both bots must finish the study


def lines_of_readme(folder: Path) -> dict[str, Any]:
    """Return the lines of config.yml that its README shows under "Two people"."""
    section = (folder / "README.md").read_text(encoding="utf-8").partition("## Two people\n")[2].partition("\n## ")[0]
    (block,) = re.findall(r"(?:^ {4}.*\n)+", section, re.MULTILINE)
    found: dict[str, Any] = yaml.safe_load(textwrap.dedent(block))
    return found


def study_for_two(name: str, place: Path, **options: Any) -> HeldStudy:
    folder = place / name
    shutil.copytree(ROOT / "examples" / name, folder, ignore=LEFT_OUT)
    config, more = yaml.safe_load((folder / "config.yml").read_text()), lines_of_readme(folder)
    config["project"] |= more["project"]
    config["trial"] |= more["trial"] | SHORT
    config["trial"]["options"] |= options
    (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False))
    return HeldStudy(folder, place / "run" / "data", log=place / "local.log")


@pytest.mark.parametrize(
    ("name", "players", "options"),
    [
        ("overcooked", ("0", "1"), {"seconds": 8}),
        ("slime-volleyball", ("agent_left", "agent_right"), {"points": 1, "seconds": 8}),
    ],
)
def test_two_bots_play_together(name: str, players: tuple[str, str], options: dict[str, Any], tmp_path: Path) -> None:
    study = study_for_two(name, tmp_path, **options)
    try:
        study.start()
        bots = [Bot(study.link, each, Random(each), play=0, patience=PATIENCE) for each in ("ada", "bo")]

        async def walk() -> list[Any]:
            return list(await asyncio.wait_for(asyncio.gather(*(bot.run() for bot in bots)), PATIENCE))

        reports = asyncio.run(walk())
        assert [(each.errors, each.troubles, each.finished) for each in reports] == [([], [], True)] * 2
        assert verify(study.data, name, reports).missing == []
        assert [each.plays[0].outcome for each in reports] == ["finished", "finished"]
        (file,) = (study.data / name / "sessions").glob("*/trials/*/*.gz")
        steps = [line for line in read(file.read_bytes()) if line["kind"] == "step"]
        for player in players:
            assert {step["players"][player]["by"] for step in steps} == {"human", "none"}
    finally:
        study.clear()
