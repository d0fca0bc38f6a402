"""The options that several commands share, each with one meaning and one help text."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Stack = Annotated[str, typer.Option("--stack", envvar="HIPPODROME_STACK", help="The installation's name.")]
Region = Annotated[
    str | None,
    typer.Option("--region", help="The AWS region; else what AWS_REGION or the profile says.", show_default=False),
]
Profile = Annotated[
    str | None, typer.Option("--profile", help="The AWS profile; else what AWS_PROFILE says.", show_default=False)
]
Folder = Annotated[Path, typer.Argument(help="The project folder: config.yml, steps/, agent.py.")]
ProjectId = Annotated[
    str | None,
    typer.Option("--project", help="The project's id; else that of the config.yml in this folder.", show_default=False),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and do nothing.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Answer every question with yes.")]
Json = Annotated[bool, typer.Option("--json", help="The answer as JSON, for scripts.")]
