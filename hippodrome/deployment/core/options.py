"""The options that several commands share, each with one meaning and one help text."""

from __future__ import annotations

import shlex
from typing import Annotated

import typer

from hippodrome.console.arguments import StudyFolder
from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.resource_names import RESERVED_STACK_NAME, STACK_NAME


def stack_name(name: str) -> str:
    """Check and return the name of an installation. Raises `Problem` if no stack can have this name."""
    if not STACK_NAME.fullmatch(name):
        raise Problem(
            f"{name!r} cannot be the name of an installation.",
            "It has letters, digits and dashes, 30 at most, and begins with a letter (--stack).",
        )
    if RESERVED_STACK_NAME.fullmatch(name):
        raise Problem(
            f"An installation cannot be called {name}: AWS reserves that name.",
            "Choose another name (--stack).",
        )
    return name


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
Folder = StudyFolder
Study = Annotated[
    str | None,
    typer.Argument(
        metavar="STUDY", help="The study: its folder or its id; else the one in this folder.", show_default=False
    ),
]
All = Annotated[bool, typer.Option("--all", help="All studies of the installation.")]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Print what would be done, and change nothing.")]
Yes = Annotated[bool, typer.Option("--yes", "-y", help="Answer every question with yes.")]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Go on although something is in the way, such as a domain not delegated yet.")
]
Json = Annotated[bool, typer.Option("--json", help="The answer as JSON, for scripts.")]
