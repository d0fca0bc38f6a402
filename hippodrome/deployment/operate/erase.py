"""`hippodrome erase`: deletes everything about one participant, here or on AWS."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options

_ONE = "Give one of the two."


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
    json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Erase everything about one participant: documents in all their versions, recordings, their server and its traces.

    This cannot be undone. On this machine, end `run` first. On AWS, the receipt says what was deleted, when and by
    whom, and that a last listing found nothing. It names the participant by a salted hash, which anyone who knows the
    id can check. Afterwards run `data` again for each folder with downloaded data of the study: it removes the
    participant there.
    """
    from hippodrome.deployment.core.study_selection import place_of_data, selected  # noqa: PLC0415 - the checks of config.yml

    _must_fit(user_id, study, everywhere=everywhere, two_places=from_ is not None and (aws or everywhere))
    undecided = from_ is None and not aws and not everywhere  # no option says where the data are
    data = place_of_data(selected(study), "hippodrome erase USER_ID") if undecided else from_
    if data is not None:
        if everywhere or receipt is not None or with_id:
            raise Problem(
                "On this machine there is no receipt, and a participant is erased in all projects of the data folder.",
                "Leave out --everywhere, --receipt and --with-id; on AWS, add --aws.",
            )
        only = None if study is None else selected(study).id
        return _from_folder(data, only, user_id, dry_run=dry_run, yes=yes, json=json)
    from hippodrome.deployment.aws.account import open_account  # noqa: PLC0415 - boto3, which this machine's data do without
    from hippodrome.deployment.operate import aws_erasure  # noqa: PLC0415 - as above

    account = open_account(profile, region)
    only = None if everywhere else selected(study).id
    return aws_erasure.erase(
        account, stack, only, user_id, receipt=receipt, with_id=with_id, dry_run=dry_run, yes=yes, json=json
    )


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


def _from_folder(data: Path, only: str | None, user: str, *, dry_run: bool, yes: bool, json: bool) -> int:
    """Erase the participant from a data folder, in all its projects, or in the project `only`."""
    from hippodrome.deployment.operate import folder_eraser  # noqa: PLC0415 - only here
    from hippodrome.deployment.operate.folder_eraser import FolderEraser  # noqa: PLC0415 - only here

    folders = folder_eraser.folders(data)
    present = {name for folder in folders for name in folder_eraser.projects(folder)}
    _must_hold(data, only, sorted(present))
    looks = [
        (eraser, *eraser.look())
        for folder in folders
        for eraser in (FolderEraser(folder, name, user) for name in folder_eraser.projects(folder))
    ]
    concerned = [look for look in looks if (look[1] or look[2]) and only in (None, look[0].project)]
    others = {look[0].project for look in looks if (look[1] or look[2]) and only not in (None, look[0].project)}
    rows = [
        (eraser.project, str(eraser.data), f"{len(own):,}", f"{len(sessions):,}") for eraser, own, sessions in concerned
    ]
    if rows and not json:
        screen.table(["project", "data", "files", "sessions"], rows, right=["files", "sessions"])
    done = []
    if concerned and not dry_run:
        screen.confirm(f"Erase this participant for good from {', '.join(dict.fromkeys(row[0] for row in rows))}?", yes)
        done = [eraser.run() for eraser, *_ in concerned]
    for eraser, *_ in looks:
        for key in eraser.unreadable:
            screen.warning(f"{eraser.data / key} cannot be read, and may name this participant: look at it yourself.")
    if others:
        screen.warning(f"They are also in {', '.join(sorted(others))}. Without STUDY, they are erased in all.")
    elif not dry_run:
        for path in (path for folder in folders for path in folder_eraser.mentions(folder, user)):
            screen.warning(f"{path} still names them: look at it, and delete it if you do not need it.")
    files, rewritten = sum(erasure.files for erasure in done), sum(each.rewritten for each in done)
    if json:
        amount = sum(len(own) + len(sessions) for _, own, sessions in concerned)
        screen.result_json({"found": amount, "deleted": files, "rewritten": rewritten})
    if done:
        screen.success(f"{count(files, 'file')} deleted, {count(rewritten, 'recording')} rewritten without them.")
        screen.info("  Where this study was converted, run `hippodrome data` again: it removes them there.")
    elif not concerned:
        screen.success(f"There is nothing of this participant in {data}, in {only or ', '.join(sorted(present))}.")
        screen.info("  An id must be written exactly as in their link.")
    return Exit.CHANGES if dry_run and concerned else Exit.DONE


def _must_hold(data: Path, only: str | None, present: list[str]) -> None:
    """Raise `Problem` if the folder does not hold this project, or none: a wrong name must not look like an erasure."""
    if not present:
        raise Problem(
            f"{data} is not a data folder: it holds no project.",
            "Name the folder in which `hippodrome run` keeps data, such as --from ../my-study/data.",
        )
    if only not in (None, *present):
        raise Problem(
            f"{data} holds nothing of a project {only}.",
            f"It holds: {', '.join(present)}. Without STUDY, the participant is erased in all of them.",
        )
