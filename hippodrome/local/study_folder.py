"""The argument with which the commands for this machine name a study."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

StudyFolder = Annotated[
    Path,
    typer.Argument(
        metavar="STUDY",
        help="The study's folder, with config.yml, steps/ and agent.py; else the present folder.",
        show_default=False,
    ),
]
