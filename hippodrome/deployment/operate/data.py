"""`hippodrome data`: converts answers and recordings, from AWS or this machine, into tables and datasets."""

# ruff: noqa: PLC0415 - modules that only some runs need are imported there, so that the others start quickly

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hippodrome.console import formatting, screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options

if TYPE_CHECKING:
    from hippodrome.deployment.aws.account import Account
    from hippodrome.export.fetch import Tally
    from hippodrome.export.source import Source

FORMATS = ("csv", "parquet", "minari")


def command(
    study_named: options.Study = None,
    *,
    to: Annotated[
        Path | None,
        typer.Option(
            "--to", help="The folder to write into; else data-<id> in the study's folder.", show_default=False
        ),
    ] = None,
    from_: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Convert this data folder of `run` or `try` on this machine. Without --from and --aws, the one place "
            "is taken where the data can be; if they can be in both, you are asked.",
            show_default=False,
        ),
    ] = None,
    aws: Annotated[bool, typer.Option("--aws", help="Fetch the data from AWS.")] = False,
    bucket: Annotated[
        str | None,
        typer.Option(
            "--bucket",
            metavar="NAME",
            help="Fetch from this bucket, which `destroy` has kept; no installation is needed.",
            show_default=False,
        ),
    ] = None,
    formats: Annotated[
        str, typer.Option("--format", help=f"Some of {', '.join(FORMATS)}, with commas between.")
    ] = "csv,parquet",
    identities: Annotated[
        str | None,
        typer.Option(
            "--identities",
            metavar="apart",
            help="apart: ids and what recruiters' links carried go into private/; numbers stand everywhere else.",
            show_default=False,
        ),
    ] = None,
    long: Annotated[bool, typer.Option("--long", help="Write answers-long: a row for each answered field.")] = False,
    spreadsheet: Annotated[
        bool,
        typer.Option("--spreadsheet", help="CSV for Excel and its like: answers that look like formulas stay text."),
    ] = False,
    raw: Annotated[bool, typer.Option("--raw", help="Keep the files as they are in the bucket, too.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Only compare the folder with its manifest: sizes and hashes.")
    ] = False,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Fetch a study's data and convert them: from AWS, or from a data folder of this machine.

    Answers become answers.csv and answers.parquet: a row per participant, a column per field. Recordings become
    Parquet files, with episodes.csv as their index, and with --format minari a Minari dataset. manifest.json lists
    every file with its hash. Running it again fetches only what is new; it may be interrupted at any time.

    These are personal data. With --identities apart, everything outside private/ names people by numbers only.
    """
    from hippodrome.deployment.core.study_selection import folder_for, place_of_data, selected
    from hippodrome.export import run as work
    from hippodrome.export.source import Folder

    if from_ is not None and (bucket is not None or aws):
        other = "--bucket" if bucket is not None else "--aws"
        raise Problem(f"--from and {other} name two places.", "Give one of the two.", exit_code=Exit.MISUSE)
    if check:
        return _check(to or folder_for(selected(study_named), from_), as_json)
    chosen = frozenset(part.strip().lower() for part in formats.split(",") if part.strip())
    if not chosen or not chosen <= set(FORMATS):
        raise Problem(f"--format {formats}: there are {', '.join(FORMATS)}.")
    if identities not in (None, "apart"):
        raise Problem(f"--identities {identities}: there is only `apart`.")
    _packages(chosen)
    study = selected(study_named)
    undecided = from_ is None and bucket is None and not aws  # no option says where the data are
    local = place_of_data(study, "hippodrome data") if undecided else from_
    target = to or folder_for(study, local)
    wishes = work.Options(chosen, identities == "apart", raw, long, spreadsheet)
    source: Source
    if local:
        _refuse_outer(local, study.id)
        source = Folder(local)
    else:
        from hippodrome.deployment.aws.account import open_account

        source = _bucket(open_account(profile, region), stack, bucket, study.id)
    if dry_run:
        return _dry_run(work.look(source, study.id, target, wishes), target, as_json)
    outcome = work.run(source, study.id, target, wishes)
    if as_json:
        screen.result_json(outcome)
    else:
        _tell(outcome, target)
    return Exit.DONE


def _packages(formats: frozenset[str]) -> None:
    """Raise `Problem` if a package that writes one of these formats is not installed."""
    for name, needed in (("pyarrow", formats & {"parquet", "minari"}), ("minari", formats & {"minari"})):
        if needed and importlib.util.find_spec(name) is None:
            raise Problem(
                f"The package {name} is not installed, and --format {','.join(sorted(needed))} needs it.",
                'Install it: `pip install "hippodrome[data]"`, in a clone `make data`. Or leave it out: --format csv.',
            )


def _refuse_outer(folder: Path, project: str) -> None:
    """Raise `Problem` for a folder that has the project's data in folders below it, as `hippodrome try` leaves them."""
    inner = [] if (folder / project).exists() else sorted(path.parent for path in folder.glob(f"*/{project}/users"))
    if inner:
        last = inner[-1].parent
        raise Problem(
            f"The data of {project} are not in {folder}, but in a folder below it.",
            f"Name that: --from {last}.",
            [f"{path.parent} has data of {project}." for path in inner[:20]] if len(inner) > 1 else [],
        )


def _bucket(account: Account, stack: str, bucket_name: str | None, project: str) -> Source:
    """Open the installation's bucket, or the bucket of this name, which `destroy` has kept."""
    from hippodrome.deployment.aws.account import find_installation
    from hippodrome.deployment.stack.retained_bucket import open_bucket
    from hippodrome.export.bucket import Bucket

    if bucket_name is not None:
        return open_bucket(account, bucket_name, project)
    try:
        installation = find_installation(account, stack)
    except Problem as problem:
        advice = f"{problem.advice} If it was removed, its data are in the bucket that `destroy` has named: --bucket."
        raise Problem(str(problem), advice) from None
    return Bucket(account.client("s3"), installation["Bucket"], account.id)


def _check(folder: Path, as_json: bool) -> int:
    from hippodrome.export import manifest

    wrong, foreign = manifest.check(folder), manifest.foreign(folder)
    if as_json:
        screen.result_json({"folder": str(folder), "sound": not wrong, "wrong": wrong, "foreign": foreign})
    if foreign:
        names = ", ".join(foreign[:20]) + (f" … and {len(foreign) - 20} more" if len(foreign) > 20 else "")
        screen.warning(
            f"Not in the manifest: {names}. No table is made of such files, and they may be moved away. If the last "
            "run was interrupted, run the command without --check first."
        )
    if not wrong:
        screen.success(f"{folder} is as its manifest says.")
        return Exit.DONE
    raise Problem(
        f"Not as the manifest of {folder} says: {formatting.count(len(wrong), 'file')}.",
        "Run the command without --check: what is damaged is made anew.",
        wrong[:20] + ([f"… and {len(wrong) - 20} more"] if len(wrong) > 20 else []),
    )


def _dry_run(tally: Tally, target: Path, as_json: bool) -> int:
    files = {
        "new": tally.new,
        "changed": tally.changed,
        "unchanged": tally.unchanged,
        "gone": tally.gone,
        "damaged": tally.damaged,
    }
    if as_json:
        screen.result_json({"folder": str(target), "participants": tally.participants, **files, "bytes": tally.bytes})
    else:
        screen.table(["what", "files"], [(name, f"{number:,}") for name, number in files.items()], right=["files"])
        screen.result(
            f"{formatting.count(tally.participants, 'participant')}; {formatting.size(tally.bytes)} to fetch "
            f"into {target}/"
        )
    return Exit.CHANGES if tally.to_fetch or tally.gone else Exit.DONE


def _tell_agent(moved: list[dict[str, Any]]) -> None:
    """Warn about steps whose answers come from another page than the present one."""
    for step in moved:
        name, page = step["step"], step["page"]
        for other, count in step["others"].items():
            answers = formatting.count(count, "answer")
            screen.warning(f"Step {name} is {page} now, and has {answers} from {other}: column page.{name} says which.")
    if moved:
        screen.info("  `finished` is by the steps as they are now.")


def _tell(outcome: dict[str, Any], target: Path) -> None:
    counts, run = outcome["counts"], outcome["run"]
    if run["damaged"]:
        screen.warning(f"{run['damaged']:,} files here were damaged, and have been made anew.")
    if run["gone"]:
        screen.warning(f"{run['gone']:,} files are gone from the source, and so from here.")
    for dataset in outcome["minari"]:
        for why, count in dataset["leftOut"].items():
            screen.warning(f"{dataset['id']}: {count:,} episodes were left out: {why}.")
        if not dataset["observations"] and dataset["observationsRecorded"]:
            screen.warning(
                f"{dataset['id']}: observations were recorded, but Minari has no space for them: steps' numbers stand "
                "in their place. The recordings' Parquet files have them, in the column `other`."
            )
        elif not dataset["observations"]:
            screen.warning(f"{dataset['id']}: observations were not recorded; steps' numbers stand in their place.")
    if not all(dataset["observationsRecorded"] for dataset in outcome["minari"]):
        screen.info(
            "  `recordObservations: true` in `trial` of config.yml records them in games that begin after that."
        )
    _tell_agent(outcome["moved"])
    if counts["problems"]:
        problems = formatting.count(counts["problems"], "remark")
        screen.warning(f"{problems} on files that are not as they should be: {target / 'problems.csv'}")
    if target.stat().st_mode & 0o077:
        screen.warning(f"Other users of this machine can read {target}/. To change that: chmod -R go-rwx {target}")
    has_recordings = outcome["formats"] != ["csv"]
    counted = ("participants", "finished", "answers", *(("episodes", "frames") if has_recordings else ()))
    screen.table(["", "count"], [(name, f"{counts[name]:,}") for name in counted], right=["count"])
    if not has_recordings:
        screen.info("  Recordings were not fetched. --format csv,parquet makes their tables, such as episodes.csv.")
    screen.success(
        f"{run['new'] + run['changed']:,} files fetched ({formatting.size(run['bytes'])}); everything is in {target}/"
    )
    if datasets := ", ".join(dataset["id"] for dataset in outcome["minari"] if dataset["episodes"]):
        screen.info(f"  MINARI_DATASETS_PATH={target.resolve() / 'minari'} {datasets}")
    if outcome["identities"] == "apart":
        screen.info(f"  Who is who: {target / 'private/identities.csv'}. Share everything but private/.")
