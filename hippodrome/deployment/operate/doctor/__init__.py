"""`deploy doctor`: checks whether a study can be held. Each check is a line, with advice if something is wrong."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model.project import Project
from hippodrome.deployment.aws.account import Account, Installation, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import explain, options, participants
from hippodrome.deployment.core.finding import Finding, Mark, bad, examine, good, look, show
from hippodrome.deployment.core.study_selection import one_or_all
from hippodrome.deployment.operate.doctor import addresses, capacity, documents, images, safety
from hippodrome.deployment.operate.doctor.check_context import Check, CheckContext
from hippodrome.deployment.operate.doctor.play import MAX_BOTS, WITHIN
from hippodrome.deployment.operate.doctor.rehearsal import CHECK as REHEARSAL
from hippodrome.deployment.operate.doctor.rehearsal import Rehearsal, project_for
from hippodrome.deployment.stack import states
from hippodrome.deployment.stack.stack import Stack

CHECKS: dict[str, Check] = {
    "hosted zone": addresses.zone,
    "site certificate": addresses.site_certificate,
    "site": addresses.site,
    "Internet": addresses.internet,
    "certificate": addresses.certificate,
    "Fargate quotas": capacity.fargate,
    "Lambda quota": capacity.functions,
    "projects": images.projects,
    "documents": documents.documents,
    "pages": documents.step_pages,
    "bucket": safety.bucket,
    "queues": safety.queues,
    "alarms": safety.alarms,
    "alarm e-mail": safety.listeners,
}


def command(
    study: options.Study = None,
    *,
    every: options.All = False,
    at_once: Annotated[int, typer.Option("--at-once", min=1, help="How many servers a study may need together.")] = 20,
    rehearse: Annotated[
        bool, typer.Option("--rehearse", help="Also start and stop one real server; costs less than a cent.")
    ] = False,
    play: Annotated[
        int | None,
        typer.Option(
            "--play",
            min=1,
            max=MAX_BOTS,
            help="With --rehearse: send so many simulated participants through a copy of a live study, and prove what "
            "no emulator can: pages, games, data, a killed task, a timer, the sweep, an alarm. About ten minutes.",
            show_default=False,
        ),
    ] = None,
    within: Annotated[
        int, typer.Option("--within", min=5, max=60, help="With --play: minutes after which it ends in any case.")
    ] = WITHIN,
    transcript: Annotated[
        Path | None,
        typer.Option(
            "--transcript",
            help="With --play: write what was proven into this file, as JSON without ids or tokens.",
            show_default=False,
        ),
    ] = None,
    yes: options.Yes = False,
    only_aws: Annotated[
        bool, typer.Option("--only-aws", help="Ask only AWS: neither the Internet's DNS nor the site itself.")
    ] = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Check whether a study, or with --all each live one, can be held: a line for each check, with advice.

    ✓ good, ! worth a look, ✗ participants would be affected. The exit code is 1 if there is a ✗. Nothing is changed,
    except with --rehearse, which starts a server without a participant and removes it; then only its ✗ count.
    --rehearse --play 2 sends simulated participants through a copy of a live study, and removes the copy again.
    """
    if play and not rehearse:
        raise Problem("--play is a kind of rehearsal.", "Say --rehearse --play.")
    project = one_or_all(study, every)
    rehearsal: list[Finding] = []
    document: dict[str, Any] = {}
    account = open_account(profile, region)
    findings = [*credentials(account)]
    installation, diagnoses = installation_state(account, stack)
    findings += diagnoses
    if installation is not None:
        context = CheckContext(account, installation, at_once, datetime.now(UTC), fetch=addresses.fetch)
        if only_aws:
            context.delegation = context.fetch = None
        context.wanted = _wanted(context, project)
        with screen.err.status("Looking …"):
            findings += examine(context, CHECKS)
    if not as_json:
        show(findings, screen.out)
    if installation is not None and rehearse:
        if play:
            from hippodrome.deployment.operate.doctor.play.command import played  # noqa: PLC0415 - bots, and what reads data

            rehearsal, document = played(context, play, minutes=within, yes=yes, file=transcript)
        else:
            rehearsal = _rehearse(context)
        findings += rehearsal
        if not as_json:
            show(rehearsal, screen.out)
    failed = any(finding.mark is Mark.BAD for finding in rehearsal or findings)
    if as_json:
        more = {"transcript": document} if document else {}
        screen.result_json({"good": not failed, "checks": [_data(finding) for finding in findings], **more})
    else:
        _conclude(findings, rehearsal)
    return Exit.FAILED if failed else Exit.DONE


def credentials(account: Account) -> Iterator[Finding]:
    """Check the credentials, and tell whose they are. Raises botocore's errors if AWS does not accept them."""
    identity = account.identity
    name = identity["Arn"].rpartition(":")[2]
    if name == "root":
        yield look(
            "credentials",
            f"The root user of account {account.id}.",
            "Use a role or another user: root may do everything.",
        )
    else:
        yield good("credentials", f"{name} in account {account.id}.")
    yield good("region", f"{account.region}.")


def installation_state(account: Account, stack: str) -> tuple[Installation | None, list[Finding]]:
    """Find the installation (None if there is none), and check its state and version."""
    try:
        installation = find_installation(account, stack)
    except Problem as problem:
        return None, [bad("stack", str(problem), problem.advice)]
    diagnoses = []
    if installation.status in states.COMPLETE:
        diagnoses.append(good("stack", f"{stack} is in {installation.status}."))
    elif installation.status == "UPDATE_ROLLBACK_COMPLETE":
        diagnoses.append(
            look(
                "stack",
                f"{stack} works as before its last update, which failed.",
                "`hippodrome plan` says whether something is still to be changed.",
            )
        )
    else:
        diagnoses.append(
            look(
                "stack",
                f"{stack} is in {installation.status}.",
                "`hippodrome apply` finishes or repairs what was begun.",
            )
        )
    try:
        diagnoses += _version(account, stack)
    except Exception as error:  # noqa: BLE001 - it becomes a finding, and the other checks go on
        why = explain.problem_from(error) or Problem(f"{type(error).__name__}.")
        diagnoses.append(look("version", f"could not be checked: {why}", why.advice))
    return installation, diagnoses


def _version(account: Account, stack: str) -> Iterator[Finding]:
    """Check whether the stack's template is that of this version, apart from the functions' code."""
    from hippodrome.deployment.code.template import Template  # noqa: PLC0415 - YAML, which only this check needs

    present = Stack(account, stack).template()
    if present and _plain(present) != _plain(Template.read().for_region(account.region).text):
        yield look(
            "version",
            "The stack was made by another version of this command.",
            "`hippodrome plan` shows what differs.",
        )


def _plain(template: str) -> str:
    """Return the template without the hashes of the functions' code."""
    return re.sub(r"(S3Key:\s*[\"']?[A-Za-z0-9_]+?)(-[0-9a-f]{8,64})?\.zip", r"\1.zip", template).strip()


def _wanted(context: CheckContext, project_id: str | None) -> Project | None:
    """Find the registered project with this id; None: all are wanted. Raises `Problem` if it is not registered."""
    if project_id is None:
        return None
    (project,) = participants.choose(participants.registered_projects(context.platform.documents, []), project_id)
    return project


def _rehearse(context: CheckContext) -> list[Finding]:
    project = project_for(context)
    if project is None:
        return [bad(REHEARSAL, "No live project has a game: there is nothing to start.", "Register one with --live.")]
    with screen.err.status("Rehearsing …") as status:
        rehearsal = Rehearsal(
            context.platform, project, lambda text: status.update(f"Rehearsing: {text}"), reach=context.fetch
        )
        try:
            return rehearsal.run()
        except KeyboardInterrupt:
            status.stop()
            for finding in rehearsal.left:
                (screen.success if finding.mark is Mark.GOOD else screen.warning)(
                    f"{finding.text} {finding.advice}".strip()
                )
            raise
        except Exception as error:
            problem = explain.problem_from(error)
            if problem is None:
                raise
            return [bad(REHEARSAL, str(problem), problem.advice), *rehearsal.left]


def _conclude(findings: list[Finding], rehearsal: list[Finding]) -> None:
    bads = sum(1 for finding in findings if finding.mark is Mark.BAD)
    looks = sum(1 for finding in findings if finding.mark is Mark.LOOK)
    rehearsed = bool(rehearsal) and all(finding.mark is not Mark.BAD for finding in rehearsal)
    ready = "The rehearsal succeeded" if rehearsed else "" if bads else "Ready"
    sentence = f"{bads} to mend, {looks} to look at" if bads else f"{looks} to look at" if looks else ""
    screen.out.print(Text(f"{'; '.join(filter(None, (ready, sentence)))}.", style="bold"))


def _data(finding: Finding) -> dict[str, Any]:
    return {"check": finding.check, "mark": finding.mark, "text": finding.text, "advice": finding.advice}
