"""Imported where environments are made beside a participant's game: agent.py, which may register some."""

from __future__ import annotations

import os
from pathlib import Path

from protocol import environment
from trial.agent import agent

_folder = Path(os.environ[environment.AGENT_DIR])
if (_folder / "agent.py").is_file():
    agent.load(_folder)
