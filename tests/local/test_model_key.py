"""The key of a language model is in no file of a study that runs on this machine: data, logs, state, tables."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from random import Random

import pytest
import yaml

from hippodrome.bots.bot import Bot
from hippodrome.local.fake_model import FakeModel
from hippodrome.local.rehearsal.study_process import StudyProcess
from testing.processes import ROOT

KEY = "sk-the-key-of-the-study"
HINTS = """
    def on_episode_start(self, session):
        session.record("hint", session.ask("Which way?"))
        raise RuntimeError({name: os.environ.get(name) for name in ("LLM_KEY", "OPENAI_BASE_URL")})
"""


@pytest.mark.timeout(120)
def test_the_key_is_in_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, folder = FakeModel({}), tmp_path / "study"
    shutil.copytree(ROOT / "examples" / "assistant", folder, ignore=shutil.ignore_patterns("data*", ".*"))
    config = yaml.safe_load((folder / "config.yml").read_text())
    config["trial"] |= {"maxEpisodes": 1, "betweenEpisodes": 0}
    config["trial"]["llm"]["url"] = model.url
    (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False))
    agent = (folder / "agent.py").read_text().replace("    def _observation", f"{HINTS}\n    def _observation")
    (folder / "agent.py").write_text(f"import os\n{agent}")
    monkeypatch.setenv("LLM_KEY", KEY)
    study = StudyProcess(folder, folder / "data", real_llm=True)
    study.start()
    try:
        bot = Bot(study.link, "ada", Random(1), play=0, patience=60)
        asyncio.run(asyncio.wait_for(bot.run(), 90))
        assert bot.report.finished
    finally:
        study.interrupt()
        study.clear()
        model.stop()
    assert {headers["Authorization"] for _, _, headers in model.requests} == {f"Bearer {KEY}"}
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert any(path.name.endswith("-talk-0001.json") for path in files)
    assert any("on_episode_start failed" in path.read_text() for path in files if path.suffix == ".log")
    assert [path for path in files if KEY.encode() in path.read_bytes()] == []
