"""A clone's layout of HIPPO Gym on this machine: checked, held and rehearsed with the agent that lies in App/."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from hippodrome.control.config import read_project
from hippodrome.local.backend.processes import end_everything
from hippodrome.local.check.command import command as check
from hippodrome.local.rehearsal.study_process import copy_of
from testing.files import write_files
from tests.local.conftest import AGENT, ROOT, Local
from tests.local.walk import Walker

CONFIG = """\
project:
  useAWS: false
  id: old_study # letters
  live: True
  name:
  ssl:
    fullchain: SSL/fullchain.pem
    sslBucket:
  events:
    startServerStep: 1
    stopServerStep: 12
  steps:
    1: StepFiles/hello.html
    2: game
    3: StepFiles/bye.html
    finalStep: StepFiles/bye.html
trial:
  game:
  rows: 6
  maxEpisodes: 1
  startingFrameRate: 60
  actionSpace: [noop, left]
  ui: {start: True, left: True, stop: True}
"""

HELPER = "FRAMES = len(open('level.txt').read())\n"  # HIPPO's agents read files beside them from the working folder
IMPORT = (
    "import json, os\nfrom levels import FRAMES\nassert json.loads(os.environ['TRIAL'])['options'] == {'rows': 6}\n"
)


def write_clone(folder: Path, config: str = CONFIG) -> Path:
    """Write a clone with a study of its own: its agent needs what lies beside it, and plays 12 frames."""
    files = {
        "config.yml": config,
        "App/agent.py": IMPORT + AGENT.format(frames="FRAMES"),
        "App/levels.py": HELPER,
        "App/level.txt": "x" * 12,
        "App/trial.py": "raise SystemExit('HIPPO Gym runs this, Hippodrome does not')\n",
        "StepFiles/hello.html": "<h1>hello</h1><input name=word><button>Go on</button>",
        "StepFiles/bye.html": "<h1>bye</h1>",
        "updateProject.py": "",
    }
    return write_files(folder, files)


def test_a_participant_plays_with_the_agent_in_app(tmp_path: Path) -> None:
    place = tmp_path / "place"
    place.mkdir()
    here = Local(write_clone(tmp_path / "clone"), place).run()
    try:
        walker = Walker(here.url, "old_study", "P1")
        walker.answer(word="hi")
        assert walker.play(walker.until("ready"))["score"] == 12
        assert "<h1>bye</h1>" in walker.page()
        here.wait_for_text(r"server gone \(stopped\)")
        (here.folder / "App/levels.py").write_text("FRAMES = 13\n")
        here.wait_for_text(r"App/levels\.py changed: servers that start from now on run it")
    finally:
        here.kill()
        end_everything(here.state)


WITH_GYM = """\
import gym

class Agent:
    def start(self, name):
        self.env = gym.make(name)

    def reset(self):
        self.env.seed(3)
        self.env.reset()

    def step(self, choice):
        seen, gained, over, more = self.env.step(choice)
        return dict(observation=seen, reward=gained, done=over, info=more, pressed=choice)

    def render(self):
        return self.env.render("rgb_array")

    def close(self):
        self.env.close()
"""


def test_bots_walk_through_a_template_that_is_blank_with_an_agent_that_imports_gym(tmp_path: Path) -> None:
    """What HIPPO's clone brings: no id, no pages, the old interface of Gym."""
    config = (
        "project: {id: , useAWS: false, steps: {1: , 2: , finalStep: }}\ntrial: {game: MsPacman-v0, ui: {left: True}}\n"
    )
    clone = write_clone(tmp_path / "clone", config)
    (clone / "App/agent.py").write_text(WITH_GYM)
    ran = subprocess.run(
        [sys.executable, "-m", "hippodrome", "try", str(clone), "--bots", "1", "--play", "1"],
        check=False,
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert re.search(r"bots finished +│ 1 of 1", ran.stdout)
    [recording] = (clone / "data-try").rglob("*.gz")
    assert recording.relative_to(clone).parts[2:4] == ("clone", "users")


def _check(folder: Path, *options: str) -> tuple[int, list[str]]:
    app = typer.Typer()
    app.command()(check)
    ran = CliRunner().invoke(app, [str(folder), *options])
    return ran.exit_code, ran.output.splitlines()


def test_check_tries_the_agent_in_app_and_strict_refuses_remarks(tmp_path: Path) -> None:
    clone = write_clone(tmp_path / "clone")
    code, lines = _check(clone)
    assert code == 0, lines
    assert "trying App/agent.py …" in lines
    assert "  played: 1 of 1 episodes to the end, 12 steps" in lines
    assert lines[-1].startswith("No mistakes, ")
    assert {
        re.sub(r"config\.yml:\d+: remark: ", "", line).partition(":")[0] for line in lines if "config.yml" in line
    } >= {
        "project.steps.1",
        "project.events.stopServerStep",
        "trial.game",
        "trial.rows",
    }
    code, lines = _check(clone, "--strict")
    assert (code, lines[-1]) == (1, "With --strict, remarks count as mistakes.")


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("App/agent.py", "class Agent:\n  def step(\n", "App/agent.py:2: Python cannot read this"),
        ("App/levels.py", "FRAMES = 1 / 0\n", 'App/levels.py:1: start("none") fails: ZeroDivisionError'),
    ],
)
def test_mistakes_in_app_are_reported_with_the_folder(tmp_path: Path, file: str, text: str, said: str) -> None:
    clone = write_clone(tmp_path / "clone")
    (clone / file).write_text(text)
    code, lines = _check(clone)
    assert code == 1
    assert any(line.startswith(said) for line in lines), lines


def test_the_copy_for_bots_has_the_id_of_the_project(tmp_path: Path) -> None:
    text = CONFIG.replace("id: old_study", "id:").replace("ui: {start: True, left: True, stop: True}", "ui: [start]")
    clone = write_clone(tmp_path / "a clone", text)
    copy_of(clone, tmp_path / "copy")
    copied = read_project(tmp_path / "copy")
    assert copied.project.id == read_project(clone).project.id == "a-clone"
    assert copied.trial.ui.stop
    assert copied.trial.ui.start
