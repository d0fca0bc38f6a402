"""`deploy erase`: deletes everything about one participant, and writes a receipt that does not name them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import Progress, TaskID

from console import screen
from console.formatting import count
from console.problem import Exit, Problem
from deploy.aws.account import STACK, Account, Installation, find_installation, open_account
from deploy.aws.versions import VersionedBucket
from deploy.core import options, participants
from deploy.operate import receipt as receipts
from deploy.operate.eraser import ROUNDS, Eraser, FoundOfParticipant
from hippodrome.model import ids


def command(
    user: Annotated[str, typer.Argument(help="The participant's id (userId), exactly as in their link.")],
    *,
    project: options.ProjectId = None,
    from_: Annotated[
        Path | None,
        typer.Option("--from", help="Erase from this data folder of `make run`, not from AWS.", show_default=False),
    ] = None,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="Erase in every project of the installation, not in one.")
    ] = False,
    receipt: Annotated[
        Path | None,
        typer.Option("--receipt", help="Where to write the receipt; else erased-<time>.json here.", show_default=False),
    ] = None,
    with_id: Annotated[bool, typer.Option("--with-id", help="Write the id itself into the receipt, too.")] = False,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Erase everything about one participant: documents in all their versions, recordings, their server and its traces.

    This cannot be undone. The receipt says what was deleted, when and by whom, and that a last listing found nothing.
    It names the participant by a salted hash, which anyone who knows the id can check. Afterwards run `data` again for
    each folder with downloaded data of the study: it removes the participant there.
    """
    from deploy.core.study_selection import project_id  # noqa: PLC0415 - only here

    if not ids.is_user_id(user):
        raise Problem("That is no participant's id.", "Ids have letters, digits, dashes and underscores, 64 at most.")
    _must_fit(project, everywhere, from_, receipt is not None or with_id)
    if from_ is not None:
        return _from_folder(from_, project_id(project), user, dry_run=dry_run, yes=yes, json=json)
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    projects = _projects(account, installation) if everywhere else [project_id(project)]
    erasers = [Eraser(account, installation, name, user) for name in projects]
    found = {eraser.project: eraser.look() for eraser in erasers}
    concerned = [name for name, one in found.items() if one]
    if not everywhere and not concerned:
        _must_be_known(projects[0], _projects(account, installation), stack)
    if not json or dry_run:
        _show(found, json, dry_run)
    if dry_run:
        return Exit.CHANGES if concerned else Exit.DONE
    if concerned:
        screen.confirm(f"Erase this participant for good from {', '.join(concerned)}?", yes)
    began, whole = datetime.now(UTC), False
    target = receipt or _new_receipt(began)
    if target.exists() or not target.parent.is_dir():
        raise Problem(f"The receipt cannot be written to {target}.", "Name a new file in a folder that exists.")
    try:
        _erase(erasers, found)
        whole = True
    finally:
        parts = [eraser.receipt for eraser in erasers]
        made = receipts.receipt(parts, user, account, installation, began=began, whole=whole, with_id=with_id)
        if whole or any(part.deleted for part in parts):
            receipts.write(target, made)
    if json:
        screen.result_json(made)
    _warn_of_unreadable(erasers)
    if concerned:
        screen.success(f"Everything is gone. The receipt: {target}")
        screen.info("  Where this study was downloaded, run `python -m deploy data` again: it removes them there.")
    else:
        screen.success(f"There is nothing of this participant. The receipt: {target}")
    return Exit.DONE


def _new_receipt(began: datetime) -> Path:
    """Choose a file name that is free in this folder, since a script may erase several participants in a second."""
    name = f"erased-{began:%Y%m%dT%H%M%SZ}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(path for path in map(Path, (f"{each}.json" for each in names)) if not path.exists())


def _must_fit(project: str | None, everywhere: bool, data: Path | None, receipt: bool) -> None:
    """Raise `Problem` if these options do not go together."""
    if everywhere and project is not None:
        raise Problem("--project names one project, --everywhere means all of them.", "Give one of the two.")
    if data is not None and (everywhere or receipt):
        raise Problem("--from erases one project's data on this machine, without a receipt.", "Leave out the others.")


def _from_folder(data: Path, project: str, user: str, *, dry_run: bool, yes: bool, json: bool) -> int:
    from deploy.operate import folder_eraser  # noqa: PLC0415 - only here

    def confirm(files: int, sessions: int) -> None:
        extent = f"{count(files, 'file')}" + (f", and their part of {count(sessions, 'session')}" if sessions else "")
        screen.confirm(f"Erase this participant for good from {data} ({extent})?", yes)

    done, unreadable, found = folder_eraser.erase(data, project, user, dry_run=dry_run, confirm=confirm)
    for key in unreadable:
        screen.warning(f"{key} cannot be read, and may name this participant: look at it yourself.")
    for path in done.mentioned if done else ():
        screen.warning(f".hippodrome/{path} still names them: delete it; `make run` does without it.")
    if json:
        screen.result_json(
            {"found": found, "deleted": done.files if done else 0, "rewritten": done.rewritten if done else 0}
        )
    if done:
        screen.success(f"{count(done.files, 'file')} deleted, {count(done.rewritten, 'recording')} written anew.")
        screen.info("  Where this study was converted, run `python -m deploy data` again: it removes them there.")
    elif found and not json:
        screen.result(f"{count(found, 'document')} of this participant in {data}.")
    elif not found:
        screen.success(f"There is nothing of this participant in {data}.")
    return Exit.CHANGES if dry_run and found else Exit.DONE


def _projects(account: Account, installation: Installation) -> list[str]:
    """Return the ids of all projects that are registered or have documents in the bucket."""
    names = {project.id for project in participants.registered_projects(account.platform(installation).documents)}
    names.update(VersionedBucket(account, installation["Bucket"]).folders())
    return sorted(name for name in names if ids.is_project_id(name))


def _must_be_known(project: str, known: list[str], stack: str) -> None:
    """Raise `Problem` for an unknown project: a mistyped id must not look like an erasure."""
    if project not in known:
        raise Problem(
            f"The installation {stack} holds nothing of a project {project}.",
            f"Name another with --project, or take --everywhere. It holds: {', '.join(known) or 'no project yet'}.",
        )


def _erase(erasers: list[Eraser], found: Mapping[str, FoundOfParticipant]) -> None:
    with screen.ProgressBars() as bars:
        bar = bars.add_task("Erasing", total=sum(one.documents for one in found.values()))
        for eraser in erasers:
            if found[eraser.project] and (left := eraser.run(lambda count: _advance(bars, bar, count))):
                raise Problem(
                    f"After {ROUNDS} rounds there is still something in {eraser.project}: {_words(left)}.",
                    "The participant's link is in use. Close the study with `register --no-live`, and run this again.",
                )


def _warn_of_unreadable(erasers: list[Eraser]) -> None:
    for key in itertools.chain.from_iterable(eraser.unreadable() for eraser in erasers):
        screen.warning(
            f"{key} cannot be read, and may hold a hash of the id: `python -m deploy doctor` says what to do."
        )


def _advance(bars: Progress, bar: TaskID, count: int) -> None:
    """Advance the bar. If more is deleted than was found, such as the server's last recording, the total grows."""
    task = bars.tasks[0]
    bars.update(bar, advance=count, total=max(task.total or 0, task.completed + count))


def _show(found: Mapping[str, FoundOfParticipant], json: bool, dry_run: bool) -> None:
    if json:
        screen.result_json({"found": {name: one.counts() for name, one in found.items()}})
        return
    rows = [(name, *one.counts().values()) for name, one in found.items() if one]
    if rows:
        heads = max((list(one.counts()) for one in found.values()), key=len)
        screen.table(["project", *heads], [(*row, *[0] * (len(heads) + 1 - len(row))) for row in rows], right=heads)
        _warn_of_others(found)
    elif dry_run:
        screen.result(f"There is nothing of this participant in {', '.join(found) or 'any project'}.")


def _warn_of_others(found: Mapping[str, FoundOfParticipant]) -> None:
    """Warn that the servers of sessions will be stopped on which other participants still play."""
    playing = sum(not each.is_closed for one in found.values() for each in one.of_sessions)
    if playing:
        screen.warning(
            f"They play with others now: {count(playing, 'session')} will be stopped, for all who play there."
        )


def _words(found: FoundOfParticipant) -> str:
    return ", ".join(f"{count:,} {what}" for what, count in found.counts().items() if count)
