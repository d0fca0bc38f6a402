"""`python -m deploy COMMAND`: the commands, and what becomes of their errors."""

from __future__ import annotations

import importlib
import os
import re
import sys
from collections.abc import Sequence

from deploy.core import venv

try:
    import typer
    from typer.exceptions import TyperException

    from console import screen
    from console.problem import Exit, Problem
    from deploy.core import explain
except ModuleNotFoundError:
    venv.go_on()

COMMANDS = {  # each is the function `command` of its module, and its docstring is the help
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
    """Run one command; return its exit code (`console.problem.Exit`). No traceback, unless HIPPODROME_DEBUG is set."""
    arguments = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    try:
        wanted = [arguments[0]] if arguments[0] in COMMANDS else list(COMMANDS)
        ended = int(_app(wanted)(args=arguments, prog_name="python -m deploy", standalone_mode=False) or Exit.DONE)
        if ended == Exit.INTERRUPTED:  # typer's own way with Ctrl-C
            raise KeyboardInterrupt
        return ended
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
    """The commands of these names. Only the one that is run is imported, because each import takes its time."""
    app = typer.Typer(
        help="Hippodrome on AWS: one installation for everybody's studies, and a server for each participant.",
        add_completion=False,
        rich_markup_mode=None,
    )
    app.callback()(lambda: None)  # without it, an app of one command would not take the command's name
    for name in names:
        command = importlib.import_module(f"deploy.{COMMANDS[name]}").command
        app.command(name, short_help=re.split(r"[.,:]", command.__doc__, maxsplit=1)[0])(command)
    return app


if __name__ == "__main__":
    sys.exit(main())
