"""The argument with which commands that read a study's folder name it."""

from __future__ import annotations

import shlex
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

StudyFolders = Annotated[
    list[Path] | None,
    typer.Argument(
        metavar="STUDY…",
        help="The study's folder, with config.yml, steps/ and agent.py; else the present folder. With --host several.",
        show_default=False,
    ),
]
"""The same for a command that may be given several folders."""


def folder_argument(folder: Path) -> str:
    """Return the argument that names a study by its folder in every command; a word alone may be an id there."""
    return shlex.quote(str(folder) if len(folder.parts) > 1 else f"{folder}/")
