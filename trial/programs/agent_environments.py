"""Imports agent.py, which may register environments, in the process that makes environments for programs."""

from __future__ import annotations

import os
from pathlib import Path

from protocol import environment
from trial.agent import agent

_folder = Path(os.environ[environment.AGENT_DIR])
if (_folder / "agent.py").is_file():
    agent.load(_folder)
