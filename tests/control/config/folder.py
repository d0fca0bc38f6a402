"""A researcher's folder to read: `SMALL` and `HIPPO` are config.yml files without a mistake."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest

from hippodrome.control.config import Config, ConfigErrors, read_project

PAGES = ("consent", "briefing-0", "briefing-1", "briefing-2", "survey", "thanks")

HIPPO = """\
project:
  useAWS: true # bool, set false to ignore the AWS entries
  awsSetup:
    bucket: paddle.lab # working bucket
    region: eu-north-1
    rootDomain: play.paddle.example
    cpu: 1
    memory: 4

  events:
    startServerStep: 2 # int
    stopServerStep: 4
  id: paddle-feedback-2
  live: True
  maxRuntime: 45 # minutes
  name: Paddle with feedback
  researcher: Mio Sørensen
  ssl:
    fullchain: certs/fullchain.pem
    privkey: certs/privkey.pem
    sslBucket: paddle.lab
  steps:
    1: consent.html
    2: briefing.html
    3: game
    4: survey.html
    finalStep: thanks.html
  teamMembers:
trial:
  actionBufferLifespan: 5
  maxEpisodes: 3
  game: ALE/Pong-v5
  dataFile: trial
  s3upload: True
  actionSpace: [noop, fire, right, left]
  allowFramRateChange: yes
  frameRateStepSize: 5
  minFrameRate: 5
  maxFrameRate: 60
  startingFrameRate: 30
  ui:
    left: True
    right: True
    up: False
    start: True
    pause:
"""

SMALL = """\
project:
  id: small
  steps:
    1: consent
    2: game
    3: thanks
trial:
  game: CartPole-v1
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project folder with pages and no config.yml yet."""
    (tmp_path / "steps").mkdir()
    for page in PAGES:
        (tmp_path / "steps" / f"{page}.html").write_text(f"<h1>{page}</h1>", encoding="utf-8")
    return tmp_path


def read(folder: Path, text: str) -> Config:
    (folder / "config.yml").write_text(textwrap.dedent(text), encoding="utf-8")
    return read_project(folder)


def mistakes(folder: Path, text: str | bytes) -> list[str]:
    """Return the messages that a researcher sees for this config.yml, one per line."""
    data = text if isinstance(text, bytes) else textwrap.dedent(text).encode()
    (folder / "config.yml").write_bytes(data)
    with pytest.raises(ConfigErrors) as caught:
        read_project(folder)
    lines = str(caught.value).splitlines()
    assert lines == [str(problem) for problem in caught.value.diagnostics]
    return lines


def small(project: str = "", trial: str = "", steps: str = "") -> str:
    """SMALL with more lines in its sections; `steps` replaces the steps."""
    text = SMALL
    if steps:
        text = re.sub(r"(?<=  steps:\n)(    .*\n)+", lambda _: textwrap.indent(steps, "    "), text)
    before, after = text.split("trial:\n")
    return before + textwrap.indent(project, "  ") + "trial:\n" + after + textwrap.indent(trial, "  ")


def only_mistake(folder: Path, text: str | bytes) -> str:
    """Return the one mistake of a file, without the file's name and line."""
    (line,) = mistakes(folder, text)
    return re.sub(r"^config\.yml(:\d+)?: ", "", line)
