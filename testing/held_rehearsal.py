"""Runs `python -m local.rehearsal` so that the process of its study, too, starts with its imports already done."""

from __future__ import annotations

import runpy

from local.rehearsal import study_process
from testing.held_study import HeldStudy

if __name__ == "__main__":
    setattr(study_process, "StudyProcess", HeldStudy)  # noqa: B010 - a class is no variable for mypy
    runpy.run_module("local.rehearsal", run_name="__main__", alter_sys=True)
