"""The options that several commands share, each with one meaning and one help text."""

from __future__ import annotations

import os
import shlex
from pathlib import Path
from typing import Annotated

import typer

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import RESERVED_STACK_NAME, STACK_NAME


def is_folder(given: str) -> bool:
    """Whether `--project` names a folder, not an id: ids hold no slashes and no dots."""
    return "/" in given or os.sep in given or given in {".", ".."}


def project_id(given: str | None) -> str | None:
    """Return the id in `--project`, or the id of the folder that it names. Raises `Problem` if that has none."""
    if given is None or not is_folder(given):
        return given
    from hippodrome.deployment.core.project_folder import id_in  # noqa: PLC0415 - the checks of config.yml, only where a folder is named

    found = id_in(Path(given))
    if found is None:
        raise Problem(f"{given} has no config.yml with a project id.", "Name the project's folder, or its id.")
    return found


def stack_name(given: str) -> str:
    """Check and return the name of an installation. Raises `Problem` if no stack can have this name."""
    if not STACK_NAME.fullmatch(given):
        raise Problem(
            f"{given!r} cannot be the name of an installation.",
            "It has letters, digits and dashes, 30 at most, and begins with a letter (--stack, with make: STACK=).",
        )
    if RESERVED_STACK_NAME.fullmatch(given):
        raise Problem(
            f"An installation cannot be called {given}: AWS reserves that name.",
            "Choose another name (--stack, with make: STACK=).",
        )
    return given


def same_place(region: str, profile: str | None) -> str:
    """Return the options, as a text, with which another command uses the same account and region."""
    return f"--region {region}" + (f" --profile {shlex.quote(profile)}" if profile else "")


Stack = Annotated[
    str, typer.Option("--stack", callback=stack_name, envvar="HIPPODROME_STACK", help="The installation's name.")
]
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
    typer.Option(
        "--project",
        callback=project_id,
        help="The project's id or its folder; if left out, the id in this folder's config.yml.",
        show_default=False,
    ),
]
OneProject = Annotated[
    str | None,
    typer.Option(
        "--project", callback=project_id, help="Only this project, named by its id or its folder.", show_default=False
    ),
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print what would be done, and change nothing.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Answer every question with yes.")]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Go on although something is in the way, such as a domain not delegated yet.")
]
Json = Annotated[bool, typer.Option("--json", help="The answer as JSON, for scripts.")]
