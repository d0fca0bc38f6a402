"""`python -m deploy COMMAND`: runs a command, and turns its errors into sentences and exit codes."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence

from hippodrome.deployment.core import venv

try:
    import typer
    from typer.exceptions import TyperException

    from hippodrome.console import screen
    from hippodrome.console.problem import Exit, Problem
    from hippodrome.deployment.core import explain
except ModuleNotFoundError:
    venv.go_on()

COMMANDS = {  # name → module, whose function `command` runs; the docstring of that function is the help text
    "up": "lifecycle.up",
    "plan": "lifecycle.plan",
    "apply": "lifecycle.apply",
    "certificate": "stack.certificate",
    "register": "study.register",
    "links": "study.links",
    "doctor": "operate.doctor",
    "status": "operate.status",
    "cost": "cost.cost",
    "data": "operate.data",
    "erase": "operate.erase",
    "logs": "operate.logs",
    "stop": "operate.stop",
    "destroy": "lifecycle.destroy",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code (`hippodrome.console.problem.Exit`).

    An error is printed as a sentence with advice. With HIPPODROME_DEBUG set, an error of the program is raised.
    """
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        wanted = [arguments[0]] if arguments[0] in COMMANDS else list(COMMANDS)
        code = int(_app(wanted)(args=arguments, prog_name="python -m deploy", standalone_mode=False) or Exit.DONE)
        if code == Exit.INTERRUPTED:  # typer returns it after Ctrl-C
            raise KeyboardInterrupt
        return code
    except (KeyboardInterrupt, typer.Abort):
        screen.warning("Interrupted. The same command goes on from here.")
        return Exit.INTERRUPTED
    except TyperException as misuse:
        screen.show_problem(Problem(misuse.format_message(), "--help tells what a command takes."))
        return misuse.exit_code
    except Exception as error:
        if os.environ.get("HIPPODROME_DEBUG"):
            raise
        problem = explain.problem_from(error) or Problem(
            f"This should not have happened: {type(error).__name__}: {error}",
            "Run it again with HIPPODROME_DEBUG=1 and send us what it prints.",
        )
        screen.show_problem(problem)
        return problem.exit_code


def _app(names: Sequence[str]) -> typer.Typer:
    """Make the typer application with these commands. This imports their modules, which takes time."""
    app = typer.Typer(
        help="Hippodrome on AWS: one installation for everybody's studies, and a server for each participant.",
        add_completion=False,
        rich_markup_mode=None,
    )
    app.callback()(lambda: None)  # without a callback, an app with one command does not take that command's name
    for name in names:
        command = importlib.import_module(f"hippodrome.deployment.{COMMANDS[name]}").command
        app.command(name, short_help=re.split(r"[.,:]", command.__doc__, maxsplit=1)[0])(command)
    return app


if __name__ == "__main__":
    sys.exit(main())
