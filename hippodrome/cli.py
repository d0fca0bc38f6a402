"""The command `hippodrome`: `hippodrome COMMAND [STUDY]`, on this machine and on AWS.

Each command lives where its work is done, in a function `command`. This module imports only the one that is run, and
turns errors into sentences and exit codes.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.exceptions import TyperException

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem

GROUPS: dict[str, dict[str, tuple[str, str]]] = {
    "On this machine": {
        "new": ("local.new", "Begin a study of your own with a copy of an example"),
        "check": ("local.check.command", "Find mistakes in config.yml, the step pages and agent.py"),
        "run": ("local.run", "Run a study on this machine, and print its link"),
        "try": ("local.rehearsal.command", "Send simulated participants through a whole study"),
        "gym": ("local.gym", "Serve Gymnasium's environments over a WebSocket"),
    },
    "Data": {
        "data": ("deployment.operate.data", "Convert a study's answers and recordings into tables"),
        "erase": ("deployment.operate.erase", "Erase everything about one participant"),
        "links": ("deployment.study.links", "Print a signed link for each participant"),
    },
    "AWS": {
        "deploy": ("deployment.lifecycle.deploy", "Put everything on AWS: installation, certificate, study"),
        "register": ("deployment.study.register", "Put a study on AWS, or its new version"),
        "secret": ("deployment.operate.secret", "Keep the key of a language model on AWS"),
        "certificate": ("deployment.stack.certificate", "Order or renew the servers' certificate"),
        "doctor": ("deployment.operate.doctor", "Check whether studies can be held, and advise if not"),
        "status": ("deployment.operate.status", "Show participants by step, servers, queues and alarms"),
        "cost": ("deployment.cost.cost", "Estimate what a study will cost, or tell what it has cost"),
        "logs": ("deployment.operate.logs", "Show what functions and servers have logged"),
        "stop": ("deployment.operate.stop", "Stop servers now, and make sure that nothing is left"),
        "destroy": ("deployment.lifecycle.destroy", "Remove the installation; the data stay"),
    },
}
"""The commands by the heading under which --help lists them: name → (module below `hippodrome`, summary)."""

COMMANDS = {name: module for group in GROUPS.values() for name, (module, _) in group.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code (`hippodrome.console.problem.Exit`).

    An error is printed as a sentence with advice. With HIPPODROME_DEBUG set, an error of the program is raised.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        code = int(_app()(args=arguments, prog_name="hippodrome", standalone_mode=False) or Exit.DONE)
        if code == Exit.INTERRUPTED:  # typer returns it after Ctrl-C
            raise KeyboardInterrupt
        return code
    except (KeyboardInterrupt, typer.Abort):
        screen.warning("Interrupted. The same command goes on from here.")
        return Exit.INTERRUPTED
    except TyperException as misuse:
        screen.show_problem(
            Problem(misuse.format_message().replace(" Value error,", ""), "--help tells what a command takes.")
        )
        return misuse.exit_code
    except Exception as error:
        if os.environ.get("HIPPODROME_DEBUG"):
            raise
        problem = _problem_from(error, arguments[0]) or Problem(
            f"This should not have happened: {type(error).__name__}: {error}",
            "Run it again with HIPPODROME_DEBUG=1 and send us what it prints.",
        )
        screen.show_problem(problem)
        return problem.exit_code


def _problem_from(error: Exception, command: str) -> Problem | None:
    """Explain an error by a problem with advice; None for an error of the program."""
    if isinstance(error, Problem):
        return error
    if isinstance(error, ModuleNotFoundError):
        of_aws = command in GROUPS["AWS"] or command == "links" or error.name in ("boto3", "botocore")
        extra = "aws" if of_aws else "data"
        target = "plan" if command == "links" else command  # it has no target of its own
        return Problem(
            f"`hippodrome {command}` needs the package {error.name}, which is not installed.",
            f'Install it with `pip install "hippodrome[{extra}]"`; in a clone, `make {target}` does.',
        )
    if "botocore" not in sys.modules:
        return None
    from hippodrome.deployment.core import explain  # noqa: PLC0415 - boto3, which may not be installed

    return explain.problem_from(error)


class _Commands(TyperGroup):
    """Lists the commands without importing them; imports the one that is run or whose options are completed."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, listed, rest = super().resolve_command(ctx, args)
        return name, listed and load(str(name)), rest

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for heading, commands in GROUPS.items():
            with formatter.section(heading):
                formatter.write_dl([(f"{name:11}", summary) for name, (_, summary) in commands.items()])


def load(name: str) -> Any:
    """Import a command's module, which may take time, and make the typer command of its function `command`."""
    app = typer.Typer(add_completion=False, rich_markup_mode=None)
    app.command(name)(importlib.import_module(f"hippodrome.{COMMANDS[name]}").command)
    return typer.main.get_command(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        screen.result(f"hippodrome {importlib.metadata.version('hippodrome')}")
        raise typer.Exit


def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Online human-AI experiments: run a study on this machine, or on AWS with a server for each participant.

    STUDY is a study's folder, or on AWS its id; left out, it is the study in the present folder.
    """


def _app() -> typer.Typer:
    app = typer.Typer(cls=_Commands, rich_markup_mode=None)
    app.callback()(_options)
    for group in GROUPS.values():
        for name, (_, summary) in group.items():
            app.command(name, cls=TyperCommand, help=summary)(lambda: None)  # replaced by `load`
    return app
