"""Erases a participant on AWS, and writes a receipt that does not name them."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from rich.progress import Progress, TaskID

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids
from hippodrome.deployment.aws.account import Account, Installation, find_installation
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import participants
from hippodrome.deployment.operate import receipt as receipts
from hippodrome.deployment.operate.eraser import ROUNDS, Eraser, FoundOfParticipant


def erase(
    account: Account,
    stack: str,
    only: str | None,
    user: str,
    *,
    receipt: Path | None,
    with_id: bool,
    dry_run: bool,
    yes: bool,
    json: bool,
) -> int:
    """Erase the participant from the project `only`, or from all of the installation. Return the exit code.

    `receipt` is the file for the receipt; None: one in this folder.
    """
    installation = find_installation(account, stack)
    projects = _projects(account, installation) if only is None else [only]
    erasers = [Eraser(account, installation, name, user) for name in projects]
    by_project = {eraser.project: eraser.look() for eraser in erasers}
    if only is not None and not any(by_project.values()):
        _must_be_known(only, _projects(account, installation), stack)
    if not json or dry_run:
        _show(by_project, json, dry_run)
    concerned = [name for name, data_found in by_project.items() if data_found]
    if dry_run:
        return Exit.CHANGES if concerned else Exit.DONE
    if concerned:
        screen.confirm(f"Erase this participant for good from {', '.join(concerned)}?", yes)
    began, whole = datetime.now(UTC), False
    target = receipt or _new_receipt(began)
    if target.exists() or not target.parent.is_dir():
        raise Problem(f"The receipt cannot be written to {target}.", "Name a new file in a folder that exists.")
    try:
        _erase(erasers, by_project)
        whole = True
    finally:
        parts = [eraser.receipt for eraser in erasers]
        written = receipts.receipt(parts, user, account, installation, began=began, whole=whole, with_id=with_id)
        if whole or any(part.deleted for part in parts):
            receipts.write(target, written)
    if json:
        screen.result_json(written)
    _warn_of_unreadable(erasers)
    if concerned:
        screen.success(f"Everything is gone. The receipt: {target}")
        screen.info("  Where this study was downloaded, run `hippodrome data` again: it removes them there.")
    else:
        screen.success(f"There is nothing of this participant. The receipt: {target}")
    return Exit.DONE


def _new_receipt(began: datetime) -> Path:
    """Choose a file name that is free in this folder, since a script may erase several participants in a second."""
    name = f"erased-{began:%Y%m%dT%H%M%SZ}"
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(path for path in map(Path, (f"{name}.json" for name in names)) if not path.exists())


def _projects(account: Account, installation: Installation) -> list[str]:
    """Return the ids of all projects that are registered or have documents in the bucket."""
    names = {project.id for project in participants.registered_projects(account.platform(installation).documents)}
    names.update(VersionedBucket(account, installation["Bucket"]).folders())
    return sorted(name for name in names if ids.is_project_id(name))


def _must_be_known(project: str, project_ids: list[str], stack: str) -> None:
    """Raise `Problem` for an unknown project: a mistyped id must not look like an erasure."""
    if project not in project_ids:
        raise Problem(
            f"The installation {stack} holds nothing of a project {project}.",
            f"Name another, or take --everywhere. It holds: {', '.join(project_ids) or 'nothing yet'}.",
        )


def _erase(erasers: list[Eraser], participants_data: Mapping[str, FoundOfParticipant]) -> None:
    with screen.ProgressBars() as bars:
        bar = bars.add_task("Erasing", total=sum(data_found.documents for data_found in participants_data.values()))
        for eraser in erasers:
            if participants_data[eraser.project] and (
                remaining := eraser.run(lambda count: _advance(bars, bar, count))
            ):
                raise Problem(
                    f"After {ROUNDS} rounds there is still something in {eraser.project}: {_words(remaining)}.",
                    "The participant's link is in use. Close the study with `register --no-live`, and run this again.",
                )


def _warn_of_unreadable(erasers: list[Eraser]) -> None:
    for key in itertools.chain.from_iterable(eraser.unreadable() for eraser in erasers):
        screen.warning(
            f"{key} cannot be read, and may hold a hash of the id: `hippodrome doctor --all` says what to do."
        )


def _advance(bars: Progress, bar: TaskID, count: int) -> None:
    """Advance the bar. If more is deleted than was found, such as the server's last recording, the total grows."""
    task = bars.tasks[0]
    bars.update(bar, advance=count, total=max(task.total or 0, task.completed + count))


def _show(participants_data: Mapping[str, FoundOfParticipant], json: bool, dry_run: bool) -> None:
    if json:
        screen.result_json({"found": {name: data_found.counts() for name, data_found in participants_data.items()}})
        return
    rows = [(name, *data_found.counts().values()) for name, data_found in participants_data.items() if data_found]
    if rows:
        heads = max((list(data_found.counts()) for data_found in participants_data.values()), key=len)
        screen.table(["project", *heads], [(*row, *[0] * (len(heads) + 1 - len(row))) for row in rows], right=heads)
        _warn_of_others(participants_data)
    elif dry_run:
        screen.result(f"There is nothing of this participant in {', '.join(participants_data) or 'any project'}.")


def _warn_of_others(participants_data: Mapping[str, FoundOfParticipant]) -> None:
    """Warn that the servers of sessions will be stopped on which other participants still play."""
    playing = sum(
        not session.is_closed for data_found in participants_data.values() for session in data_found.of_sessions
    )
    if playing:
        screen.warning(
            f"They play with others now: {count(playing, 'session')} will be stopped, for all who play there."
        )


def _words(participant_data: FoundOfParticipant) -> str:
    return ", ".join(f"{count:,} {what}" for what, count in participant_data.counts().items() if count)
