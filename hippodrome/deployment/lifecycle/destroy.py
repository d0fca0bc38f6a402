"""`deploy destroy`: removes the installation, and lists what is left. Without --data, participants' data stay."""

from __future__ import annotations

import sys
from typing import Annotated, Any

import typer
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.aws.account import Account, elsewhere, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options
from hippodrome.deployment.lifecycle.remains import look_again
from hippodrome.deployment.lifecycle.removal import FoundInstallation, Removal


def command(
    *,
    data: Annotated[bool, typer.Option("--data", help="Delete the participants' data as well, all versions.")] = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    as_json: options.Json = False,
) -> int:
    """Remove the installation: servers, stack, images, task definitions, code, logs. The data stay without --data.

    Run it again after any interruption. At the end it lists what AWS still has of it.
    """
    account = open_account(profile, region)
    account.id  # noqa: B018 - raises at once if AWS does not accept the credentials
    removal = Removal(account, stack)
    screen.info(f"Looking for the resources of {stack} in {account.region} …", "dim")
    installation = removal.look()
    if dry_run or not installation:
        return _tell(account, stack, installation, data, as_json)
    _show(installation, data)
    if installation.stack or installation.things or data:
        _ask(stack, data and bool(installation.data), yes)
        removal.run(installation, data)
    remains = look_again(removal, installation.resources)
    if as_json:
        screen.result_json(remains.as_json())
    else:
        remains.show()
    return remains.conclude(options.same_place(account.region, profile))


def _tell(account: Account, stack: str, installation: FoundInstallation, data: bool, as_json: bool) -> int:
    if as_json:
        screen.result_json(_as_json(installation))
    elif installation:
        _show(installation, data)
    else:
        screen.result(f"There is nothing of {stack} in {account.region}.")
        if hint := elsewhere(account, stack):
            screen.warning(hint)
    to_do = installation.stack or installation.things or (data and installation.data)
    return Exit.CHANGES if to_do else Exit.DONE


def _show(installation: FoundInstallation, data: bool) -> None:
    if installation.stack:
        screen.info(f"  - the stack, {installation.stack['StackStatus']}, with all that it made", "red")
    for kind in dict.fromkeys(thing.kind for thing in installation.things):
        names = [thing.name for thing in installation.things if thing.kind == kind]
        screen.info(f"  - {kind}: {names[0] if len(names) == 1 else len(names)}", "red")
    for attached in installation.attached:
        screen.info(f"  - the policy {attached.name}, which is taken from {attached.whom}", "red")
    for bucket in installation.data:
        if data:
            screen.info(f"  - the participants' data: the bucket {bucket}, every version", "bold red")
        else:
            screen.info(f"  = the participants' data stay: the bucket {bucket}")
    if data and installation.data:
        screen.info(
            "  The servers' certificate goes with the data. Let's Encrypt issues five for a domain in a week; without "
            "--data the next installation takes it over."
        )


def _as_json(installation: FoundInstallation) -> dict[str, Any]:
    return {
        "stack": installation.stack["StackStatus"] if installation.stack else None,
        "things": [{"kind": thing.kind, "name": thing.name} for thing in installation.things],
        "data": list(installation.data),
    }


def _ask(stack: str, data: bool, yes: bool) -> None:
    if yes:
        return
    extent = "everything, the participants' data included" if data else "all of this"
    if not sys.stdin.isatty():
        advice = "Add --yes to go on without."
        raise Problem(f"There is no terminal in which to type {stack}.", advice, exit_code=Exit.DECLINED)
    screen.err.print(Text(f"To remove {extent}, type the stack's name: "), end="")
    if screen.read_line() != stack:
        raise Problem("Nothing was removed.", exit_code=Exit.DECLINED)
