"""A study that a test holds in a process of its own."""

from __future__ import annotations

import os
from typing import Any

from local.rehearsal.study_process import ROOT, Process, StudyProcess
from testing import preloaded


class HeldStudy(StudyProcess):
    """`StudyProcess`, whose process begins with its imports done."""

    def _begin(self, arguments: list[str], **options: Any) -> Process:
        options["env"] = {**options["env"], "PYTHONPATH": os.environ.get("PYTHONPATH") or str(ROOT)}
        return preloaded.start("local", arguments, **options)
