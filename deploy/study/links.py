"""`deploy links`: prints a signed link for each participant (`signedLinks: true`)."""

from __future__ import annotations

import csv
import secrets
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated
from urllib.parse import urlencode

import typer

from console import screen
from console.problem import Exit, Problem
from deploy.aws.account import STACK, Account, Installation, find_installation, open_account
from deploy.core import options, participants, register_function
from hippodrome.model import ids
from hippodrome.model.project import Project
from hippodrome.registry import MAX_SIGNED


def command(
    file: Annotated[
        Path | None, typer.Argument(help="A file with an id on each line; - reads them from stdin.", show_default=False)
    ] = None,
    *,
    new: Annotated[int, typer.Option("--new", min=0, max=100_000, help="Make this many new ids.")] = 0,
    project: options.ProjectId = None,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Print a signed link for each participant, as CSV: userId,link. Nothing is changed.

    A person who opens a link is that participant: give each link to one person only. The same id always gives the same
    link, for as long as the project is registered.
    """
    from deploy.core.study_selection import project_id  # noqa: PLC0415 - only here

    users = [*(_read(file) if file else ()), *(secrets.token_hex(12) for _ in range(new))]
    if not users:
        raise Problem("No participants are named.", "Name a file with an id on each line, or make ids with --new 50.")
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    documents = account.platform(installation).documents
    (found,) = participants.choose(participants.registered_projects(documents), project_id(project))
    if not found.signed_links:
        screen.warning(f"{found.id} lets everybody in: its config.yml does not say signedLinks: true.")
    signatures = signed(account, installation, found.id, users)
    made = [(user, link(installation["Site"], found, user, signature)) for user, signature in signatures.items()]
    if as_json:
        screen.result_json([{"userId": user, "link": address} for user, address in made])
    else:
        csv.writer(sys.stdout, lineterminator="\n").writerows([("userId", "link"), *made])
    return Exit.DONE


def signed(account: Account, installation: Installation, project_id: str, users: Sequence[str]) -> dict[str, str]:
    """Ask the function that has the secret for signatures. Return them by id, in the order of `users`.

    Raises `Problem` if the function fails, or is too old to sign links.
    """
    found: dict[str, str] = {}
    for start in range(0, len(users), MAX_SIGNED):
        chunk = list(users[start : start + MAX_SIGNED])
        answer = register_function.ask(account, installation, {"links": {"projectId": project_id, "userIds": chunk}})
        signatures = answer.get("signatures")
        if not isinstance(signatures, list) or len(signatures) != len(chunk):
            raise Problem("The installation signs no links.", "Bring it up to date with `python -m deploy apply`.")
        found |= dict(zip(chunk, map(str, signatures), strict=True))
    return found


def link(site: str, project: Project, user_id: str, signature: str) -> str:
    """Make the signed address with which this participant begins."""
    return f"{site.rstrip('/')}/next?{urlencode({'projectId': project.id, 'userId': user_id, 'signature': signature})}"


def _read(file: Path) -> list[str]:
    """Read the ids in a file, in their order, each once. Raises `Problem` if a line is neither an id nor empty."""
    try:
        text = sys.stdin.read() if str(file) == "-" else file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise Problem(f"{file} cannot be read.", "It must be a UTF-8 text file with an id on each line.") from error
    return _checked(text.splitlines(), str(file))


def _checked(lines: Iterable[str], name: str) -> list[str]:
    found: dict[str, None] = {}
    for number, line in enumerate(lines, 1):
        user = line.strip()
        if user and not ids.is_user_id(user):
            advice = "An id has letters, digits, dashes and underscores, 64 at most; one on each line, nothing else."
            raise Problem(f"{name}:{number}: that is no participant's id.", advice)
        if user:
            found[user] = None
    return list(found)
