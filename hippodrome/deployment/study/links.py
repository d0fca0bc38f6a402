"""`hippodrome links`: prints a signed link for each participant (`signedLinks: true`)."""

from __future__ import annotations

import codecs
import csv
import re
import secrets
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated
from urllib.parse import urlencode

import typer

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.registry import MAX_SIGNED
from hippodrome.deployment.aws.account import Account, Installation, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options, participants, register_function

_AROUND = " \u00a0\u200b\u2060\ufeff\"'"
_HEADING = re.compile(
    r"(?:.+[_ -])?(?i:p?ids?|codes?|names?|users?|workers?|participants?|subjects?|respondents?)"
    r"|.*[a-z]I[Dd]s?|(?i:(?:user|worker|participant|prolific|subject|respondent|survey)(?:p?id|code)s?)"
)
"""The heading of a column of ids, such as `PROLIFIC_PID`, `Participant id` or `userId`."""
_ROUNDED = re.compile(r"[0-9][.,]?[0-9]*[Ee]\+?[0-9]+|[0-9]+\.0*")


def command(
    study: options.Study = None,
    *,
    file: Annotated[
        Path | None,
        typer.Option("--ids", metavar="FILE", help="A file with an id on each line; - is stdin.", show_default=False),
    ] = None,
    new: Annotated[int, typer.Option("--new", min=0, max=100_000, help="Make this many new ids.")] = 0,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Print a signed link for each participant, as CSV: userId,link. Nothing is changed.

    A person who opens a link is that participant: give each link to one person only. The same id always gives the same
    link, for as long as the project is registered.
    """
    from hippodrome.deployment.core.study_selection import selected  # noqa: PLC0415 - only here

    users = [*(_read(file) if file else ()), *(secrets.token_hex(12) for _ in range(new))]
    if not users:
        raise Problem(
            "No participants are named.", "Give a file with an id on each line, --ids FILE, or make ids with --new 50."
        )
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    documents = account.platform(installation).documents
    (project,) = participants.choose(participants.registered_projects(documents), selected(study).id)
    if not project.signed_links:
        screen.warning(f"{project.id} lets everybody in: its config.yml does not say signedLinks: true.")
    signatures = signed(account, installation, project.id, users)
    rows = [(user, link(installation["Site"], project, user, signature)) for user, signature in signatures.items()]
    if as_json:
        screen.result_json([{"userId": user, "link": address} for user, address in rows])
    else:
        csv.writer(sys.stdout, lineterminator="\n").writerows([("userId", "link"), *rows])
    return Exit.DONE


def signed(account: Account, installation: Installation, project_id: str, users: Sequence[str]) -> dict[str, str]:
    """Ask the function that has the secret for signatures. Return them by id, in the order of `users`.

    Raises `Problem` if the function fails or refuses.
    """
    found: dict[str, str] = {}
    for start in range(0, len(users), MAX_SIGNED):
        chunk = list(users[start : start + MAX_SIGNED])
        answer = register_function.ask(account, installation, {"links": {"projectId": project_id, "userIds": chunk}})
        signatures = answer.get("signatures")
        if not isinstance(signatures, list) or len(signatures) != len(chunk):
            raise Problem("The links were not signed.", details=list(map(str, answer.get("problems", []))))
        found |= dict(zip(chunk, map(str, signatures), strict=True))
    return found


def link(site: str, project: Project, user_id: str, signature: str) -> str:
    """Make the signed address with which this participant begins."""
    return f"{site.rstrip('/')}/next?{urlencode({'projectId': project.id, 'userId': user_id, 'signature': signature})}"


def _read(file: Path) -> list[str]:
    """Read the ids in a file, in their order, each once. Raises `Problem` if a line is neither an id nor empty."""
    try:
        data = sys.stdin.buffer.read() if str(file) == "-" else file.read_bytes()
        text = data.decode("utf-16" if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) else "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise Problem(f"{file} cannot be read.", "It must be a UTF-8 text file with an id on each line.") from error
    return _checked(text.splitlines(), str(file))


def _checked(lines: Iterable[str], name: str) -> list[str]:
    """The ids in these lines, without what spreadsheets add: a heading, quotes, empty cells, invisible characters."""
    users: dict[str, None] = {}
    cells = [[cell.strip(_AROUND) for cell in re.split(r"[,;\t]", line)] for line in lines]
    rows = [(number, [cell for cell in row if cell]) for number, row in enumerate(cells, 1) if any(row)]
    for at, (number, row) in enumerate(rows):
        if len(row) > 1:
            raise Problem(f"{name}:{number}: there is more than an id.", "Keep only the column with the ids.")
        if at == 0 and _HEADING.fullmatch(row[0]):
            screen.warning(f"{name}:{number}: this line is taken as the heading of the ids, and gets no link.")
        elif ids.is_user_id(row[0]):
            users[row[0]] = None
        elif _ROUNDED.fullmatch(row[0]):
            advice = "Give the column the format Text, and enter the ids again: the digits of this one are lost."
            raise Problem(f"{name}:{number}: a spreadsheet has made a number of this id.", advice)
        else:
            advice = "An id has letters, digits, dashes and underscores, 64 at most; one on each line, nothing else."
            raise Problem(f"{name}:{number}: that is no participant's id.", advice)
    return list(users)
