"""`hippodrome secret`: stores, lists and removes the secrets of an installation's studies."""

from __future__ import annotations

import getpass
import sys
from datetime import datetime
from enum import StrEnum
from typing import Annotated

import typer

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.aws.account import find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options, secret_parameters


class Action(StrEnum):
    """What to do with secrets."""

    SET = "set"
    LIST = "list"
    REMOVE = "remove"


def command(
    action: Annotated[
        Action, typer.Argument(help="set stores a secret, or its new value; list shows names and dates.")
    ],
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="LLM_KEY: the language model's key.", show_default=False)
    ] = None,
    *,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Keep the key of a language model on AWS, for studies with trial.llm.

    The value is asked for, and not shown; or it comes from stdin. It is never an argument, and no command prints it.
    Servers get it when they start: those that run keep what they have.
    """
    name = _checked(action, name)
    value = secret_parameters.check_value(_read(name)) if name and action is Action.SET else ""
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    if name is None:
        _show(secret_parameters.stored(account, installation.stack), as_json)
        return Exit.DONE
    if action is Action.SET:
        replaced = secret_parameters.store(account, installation.stack, name, value)
        existed, done = replaced, f"{name} {'has its new value' if replaced else 'is stored'}."
    else:
        existed = secret_parameters.remove(account, installation.stack, name)
        done = f"{name} is removed." if existed else f"There was no {name}."
    screen.success(done)
    if existed:
        screen.info("Servers that run now keep what they had until they end. `hippodrome register` replaces warm ones.")
    if action is Action.REMOVE and existed:
        screen.warning("No server of a study with trial.llm can start until there is one again.")
    if as_json:
        screen.result_json({"name": name, "action": action, "existed": existed})
    return Exit.DONE


def _checked(action: Action, name: str | None) -> str | None:
    """Return the name for `set` and `remove`, and None for `list`. Raises `Problem` if the name does not fit."""
    if action is Action.LIST:
        if name is not None:
            raise Problem("`list` takes no name: it shows all secrets.", exit_code=Exit.MISUSE)
        return None
    if name is None:
        names = ", ".join(secret_parameters.NAMES)
        raise Problem(f"`{action}` needs the name of a secret: {names}.", exit_code=Exit.MISUSE)
    if "=" in name:  # the shell's history has it now
        raise Problem(
            "A secret's value is never an argument: other users of this machine can see arguments, and the shell keeps "
            "them.",
            "Make a new key, and give it at the prompt, or on stdin.",
            exit_code=Exit.MISUSE,
        )
    return secret_parameters.check_name(name)


def _read(name: str) -> str:
    """Read the value at a prompt without echo; all of stdin if it is no terminal."""
    if sys.stdin.isatty():
        return getpass.getpass(f"{name} (not shown): ")
    return sys.stdin.read(secret_parameters.MAX_LENGTH + 100)


def _show(stored: dict[str, datetime], as_json: bool) -> None:
    if as_json:
        screen.result_json([{"name": name, "stored": when} for name, when in stored.items()])
    elif stored:
        screen.table(["secret", "stored"], [(name, f"{when:%Y-%m-%d %H:%M %Z}") for name, when in stored.items()])
    else:
        screen.result("There are no secrets. `hippodrome secret set LLM_KEY` stores the key of a language model.")
