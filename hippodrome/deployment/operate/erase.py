"""`hippodrome erase`: deletes everything about one participant, here or on AWS, and writes a receipt."""

from __future__ import annotations

import hashlib
import itertools
import json
import secrets
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Protocol

import typer

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options
from hippodrome.deployment.operate.eraser import Eraser

_ONE = "Give one of the two."
MENTIONS = 20  # files that are named one by one
COPIES = "Downloaded copies: `hippodrome data` into the same folder removes this participant there too."
QUEUES = "Messages about their server that are still in a queue; SQS deletes them, dead letters after 14 days at most."
AWS = "AWS's own records: ECS shows a stopped task for an hour, CloudTrail may keep the call that ran it for 90 days."
RECRUITER = "What the recruiter knows of them."
NOTHING = "There is nothing of this participant"


class Erasure(Protocol):
    """Erases a participant from one project: `FolderErasure` or `AwsErasure`."""

    project: str
    place: str  # for people: the data folder, or the installation
    eraser: Eraser
    ended: dict[str, int]  # the servers that were ended, and their resources, by kind
    playing: int  # sessions that will be stopped while others play

    def look(self) -> dict[str, int]:
        """Return how much there is of the participant, by kind. Changes nothing."""

    def run(self, advance: Callable[[int], object]) -> dict[str, int]:
        """Erase, and return what is left. `advance` gets the numbers of deleted documents."""


Looks = dict[Erasure, dict[str, int]]
"""What the last look found in each project, by kind."""


@dataclass(frozen=True)
class Place:
    """Where data lie: on this machine, or on AWS."""

    erasures: Sequence[Erasure]  # for each project
    about: Mapping[str, str]  # for the receipt
    not_covered: Sequence[str]  # what `erase` does not reach
    mentions: Callable[[str], list[Path]] = lambda user: []  # files that still name the participant


def command(
    user_id: Annotated[str, typer.Argument(help="The participant's id (userId), exactly as in their link.")],
    study: Annotated[
        str | None,
        typer.Argument(
            metavar="STUDY",
            help="The study: its folder or its id; else the one in this folder, or with --from all in that folder.",
            show_default=False,
        ),
    ] = None,
    *,
    from_: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Erase from this data folder of `run` on this machine. Without --from and --aws, the one place is "
            "taken where the data can be; if they can be in both, you are asked.",
            show_default=False,
        ),
    ] = None,
    aws: Annotated[bool, typer.Option("--aws", help="Erase on AWS.")] = False,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="Erase on AWS, in every study of the installation.")
    ] = False,
    receipt: Annotated[
        Path | None,
        typer.Option("--receipt", help="Where to write the receipt; else erased-<time>.json here.", show_default=False),
    ] = None,
    with_id: Annotated[bool, typer.Option("--with-id", help="Write the id itself into the receipt, too.")] = False,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Erase everything about one participant: documents in all their versions, recordings, their server and its traces.

    This cannot be undone. On this machine, end `run` first. The receipt says what was deleted, when and by whom, and
    that a last look found nothing. It names the participant by a salted hash, which anyone who knows the id can check.
    Afterwards run `data` again for each folder with downloaded data of the study: it removes the participant there.
    """
    from hippodrome.deployment.core.study_selection import place_of_data, selected  # noqa: PLC0415 - the checks of config.yml

    _must_fit(user_id, study, everywhere=everywhere, two_places=from_ is not None and (aws or everywhere))
    undecided = from_ is None and not aws and not everywhere  # no option says where the data are
    data = place_of_data(selected(study), "hippodrome erase USER_ID") if undecided else from_
    if data is not None:
        place = _here(data, None if study is None else selected(study).id, user_id)
    else:
        place = _on_aws(profile, region, stack, None if everywhere else selected(study).id, user_id)
    looks = {erasure: erasure.look() for erasure in place.erasures}
    if dry_run:
        _show(looks, as_json)
        return Exit.CHANGES if _concerned(looks) else Exit.DONE
    target = receipt or _new_receipt()
    if target.exists() or not target.parent.is_dir():
        raise Problem(f"The receipt cannot be written to {target}.", "Name a new file in a folder that exists.")
    if concerned := _concerned(looks):
        if not as_json:
            _show(looks, as_json)
        names = dict.fromkeys(erasure.project for erasure in concerned)
        screen.confirm(f"Erase this participant for good from {', '.join(names)}?", yes)
    paper = Receipt(user_id, place, with_id)
    try:
        _erase(looks)
    finally:
        written = paper.written(looks)
        if not _concerned(looks) or any(erasure.eraser.deleted for erasure in looks):
            _write(target, written)
    if as_json:
        screen.result_json(written)
    _warn(place, user_id)
    gone = "Everything is gone" if written["complete"] else "Everything that can be read is gone"
    screen.success(f"{gone if concerned else NOTHING}. The receipt: {target}")
    if concerned:
        screen.info("  Where this study was downloaded, run `hippodrome data` again: it removes them there.")
    else:
        screen.info("  An id must be written exactly as in their link.")
    return Exit.DONE


def _here(data: Path, only: str | None, user: str) -> Place:
    from hippodrome.deployment.operate import folder_erasure  # noqa: PLC0415 - only here

    erasures = folder_erasure.erasures(data, only, user)
    return Place(erasures, folder_erasure.about(data), (COPIES, RECRUITER), partial(folder_erasure.mentions, data))


def _on_aws(profile: str | None, region: str | None, stack: str, only: str | None, user: str) -> Place:
    from hippodrome.deployment.aws.account import find_installation, open_account  # noqa: PLC0415 - boto3, which this machine's data do without
    from hippodrome.deployment.operate import aws_erasure  # noqa: PLC0415 - as above

    account = open_account(profile, region)
    installation = find_installation(account, stack)
    erasures = aws_erasure.erasures(account, installation, only, user)
    return Place(erasures, aws_erasure.about(account, installation), (COPIES, QUEUES, AWS, RECRUITER))


def _must_fit(user: str, study: str | None, *, everywhere: bool, two_places: bool) -> None:
    """Raise `Problem` if nobody can have this id, or if these options do not go together."""
    if not ids.is_user_id(user):
        raise Problem(
            "This cannot be a participant's id.",
            "Ids have letters, digits, dashes and underscores, 64 at most.",
        )
    if everywhere and study is not None:
        raise Problem("STUDY names one study, --everywhere means all of them.", _ONE, exit_code=Exit.MISUSE)
    if two_places:
        raise Problem("--from is on this machine; --aws and --everywhere are on AWS.", _ONE, exit_code=Exit.MISUSE)


def _concerned(looks: Looks) -> list[Erasure]:
    return [erasure for erasure, found in looks.items() if any(found.values())]


def _show(looks: Looks, as_json: bool) -> None:
    if as_json:
        found: dict[str, Counter[str]] = {}
        for erasure, counts in looks.items():
            found.setdefault(erasure.project, Counter()).update(counts)
        screen.result_json({"found": found})
        return
    concerned = _concerned(looks)
    if not concerned:
        projects = ", ".join(dict.fromkeys(erasure.project for erasure in looks))
        screen.result(f"{NOTHING} in {projects or 'any project'}.")
        return
    kinds = dict.fromkeys(kind for found in looks.values() for kind, number in found.items() if number)
    rows = [(erasure.project, erasure.place, *(looks[erasure][kind] for kind in kinds)) for erasure in concerned]
    screen.table(["project", "in", *kinds], rows, right=[*kinds])
    if playing := sum(erasure.playing for erasure in looks):
        screen.warning(
            f"They play with others now: {count(playing, 'session')} will be stopped, for all who play there."
        )


def _erase(looks: Looks) -> None:
    """Erase with a progress bar; put what the last look found into `looks`. Raises `Problem` if that is something."""
    if not _concerned(looks):
        return
    with screen.ProgressBars() as bars:
        bar = bars.add_task("Erasing", total=sum(found["documents"] for found in looks.values()))

        def advance(number: int) -> None:
            """Advance the bar. If more is deleted than was found, such as a last recording, the total grows."""
            task = bars.tasks[0]
            bars.update(bar, advance=number, total=max(task.total or 0, task.completed + number))

        for erasure in _concerned(looks):
            looks[erasure] = left = erasure.run(advance)
            if any(left.values()):
                rest = ", ".join(f"{number:,} {what}" for what, number in left.items() if number)
                raise Problem(
                    f"There is still something in {erasure.project}: {rest}.",
                    "The participant's link is in use. Close the study with `register --no-live`, and run this again.",
                )


def _warn(place: Place, user: str) -> None:
    for erasure in place.erasures:
        for key in erasure.eraser.unreadable:
            screen.warning(f"{key} in {erasure.place} cannot be read, and may name this participant: look at it.")
    paths = place.mentions(user)
    for path in paths[:MENTIONS]:
        screen.warning(f"{path} still names them: look at it, and delete it if you do not need it.")
    if len(paths) > MENTIONS:
        screen.warning(f"{len(paths) - MENTIONS:,} more files name them.")


class Receipt:
    """What was erased, when and by whom, and what the last look found. It names the participant by a salted hash."""

    def __init__(self, user: str, place: Place, with_id: bool) -> None:
        salt = secrets.token_hex(16)
        self._person = {
            "salt": salt,
            "sha256": hashlib.sha256(f"{salt}{user}".encode()).hexdigest(),
            "check": "sha256 of the salt followed by the id",
            **({"userId": user} if with_id else {}),
        }
        self._place, self._began = place, _now()

    def written(self, looks: Looks) -> dict[str, Any]:
        """Return the receipt as JSON data. `looks`: what the last look found in each project."""
        return {
            "schema": 1,
            "what": "erasure of a participant's data",
            "complete": not _concerned(looks) and not any(erasure.eraser.unreadable for erasure in looks),
            "person": self._person,
            **self._place.about,
            "began": self._began,
            "ended": _now(),
            "projects": [
                {
                    "project": erasure.project,
                    "deleted": erasure.eraser.deleted,  # versions by key
                    "rewritten": list(erasure.eraser.rewritten),  # documents that others share
                    "ended": erasure.ended,
                    "left": left,
                    "unreadable": list(erasure.eraser.unreadable),
                }
                for erasure, left in looks.items()
            ],
            "notCovered": list(self._place.not_covered),
        }


def _new_receipt() -> Path:
    """Choose a file name that is free in this folder, since a script may erase several participants in a second."""
    name = f"erased-{datetime.now(UTC):%Y%m%dT%H%M%SZ}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(path for path in map(Path, (f"{name}.json" for name in names)) if not path.exists())


def _write(target: Path, receipt: Mapping[str, Any]) -> None:
    try:
        target.write_text(json.dumps(receipt, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise Problem(
            f"The receipt could not be written: {error.strerror}.",
            "Run the command again: it writes another one, of a look that finds nothing.",
        ) from None


def _now() -> str:
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}"
