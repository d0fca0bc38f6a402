"""`hippodrome doctor`: checks whether a study can be held. Each check is a line, with advice if something is wrong."""

from __future__ import annotations

import contextlib
import json
import re
import signal
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model.project import Project
from hippodrome.deployment.aws.account import Account, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options, participants
from hippodrome.deployment.core.finding import Finding, Mark, bad, examine, good, look, show
from hippodrome.deployment.core.study_selection import one_or_all
from hippodrome.deployment.cost.prices import REGION
from hippodrome.deployment.operate.doctor import addresses, capacity, documents, images, rehearsal, safety
from hippodrome.deployment.operate.doctor.check_context import Check, CheckContext
from hippodrome.deployment.stack import states
from hippodrome.deployment.stack.stack import Stack

WITHIN = 20  # minutes that a rehearsal with bots may take, without --within; about ten are usual
MAX_BOTS = 20


def stack_state(context: CheckContext) -> Iterator[Finding]:
    """Check whether the stack is complete."""
    name, status = context.installation.stack, context.installation.status
    if status in states.COMPLETE:
        yield good("stack", f"{name} is in {status}.")
    elif status == "UPDATE_ROLLBACK_COMPLETE":
        text = f"{name} works as before its last update, which failed."
        yield look("stack", text, "`hippodrome deploy --plan` says whether something is still to be changed.")
    else:
        yield look("stack", f"{name} is in {status}.", "`hippodrome deploy` finishes or repairs what was begun.")


def version(context: CheckContext) -> Iterator[Finding]:
    """Check whether the stack's template is that of this version, apart from the functions' code."""
    from hippodrome.deployment.code.template import Template  # noqa: PLC0415 - YAML, which only this check needs

    present = Stack(context.account, context.installation.stack).template()
    if present and _plain(present) != _plain(Template.read().for_region(context.account.region).text):
        text = "The stack was made by another version of this command."
        yield look("version", text, "`hippodrome deploy --plan` shows what differs.")


def _plain(template: str) -> str:
    """Return the template without the hashes of the functions' code."""
    return re.sub(r"(S3Key:\s*[\"']?[A-Za-z0-9_]+?)(-[0-9a-f]{8,64})?\.zip", r"\1.zip", template).strip()


CHECKS: dict[str, Check] = {
    "stack": stack_state,
    "version": version,
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
    account = open_account(profile, region)
    findings = [*credentials(account)]
    context: CheckContext | None = None
    try:
        installation = find_installation(account, stack)
    except Problem as problem:
        findings.append(bad("stack", str(problem), problem.advice))
    else:
        context = CheckContext(account, installation, at_once, datetime.now(UTC), fetch=addresses.fetch)
        if only_aws:
            context.delegation = context.fetch = None
        if project:
            registered = participants.registered_projects(context.platform.documents, [])
            (context.wanted,) = participants.choose(registered, project)
        with screen.err.status("Looking …"):
            findings += examine(context, CHECKS)
    rehearsed: list[Finding] = []
    document: dict[str, Any] = {}
    if not as_json:
        show(findings, screen.out)
    if context is not None and rehearse:
        try:
            document = _rehearse(context, rehearsed, play, within, transcript, yes=yes)
        except KeyboardInterrupt:
            show(rehearsed, screen.err)
            raise
        findings += rehearsed
        if not as_json:
            show(rehearsed, screen.out)
    failed = any(finding.mark is Mark.BAD for finding in rehearsed or findings)
    if as_json:
        more = {"transcript": document} if document else {}
        screen.result_json({"good": not failed, "checks": [asdict(finding) for finding in findings], **more})
    else:
        _conclude(findings, rehearsed)
    return Exit.FAILED if failed else Exit.DONE


def credentials(account: Account) -> Iterator[Finding]:
    """Check the credentials, and tell whose they are. Raises botocore's errors if AWS does not accept them."""
    identity = account.identity
    name = identity["Arn"].rpartition(":")[2]
    if name == "root":
        text = f"The root user of account {account.id}."
        yield look("credentials", text, "Use a role or another user: root may do everything.")
    else:
        yield good("credentials", f"{name} in account {account.id}.")
    yield good("region", f"{account.region}.")


def _rehearse(
    context: CheckContext, findings: list[Finding], bots: int | None, minutes: int, file: Path | None, *, yes: bool
) -> dict[str, Any]:
    """Rehearse, with this many bots or with one server alone. Add the findings, and return the transcript.

    SIGTERM and a closed terminal end it as Ctrl-C does, so that everything is removed.
    """
    project = next((p for p in context.projects if p.live and p.game_steps and p.task_definition), None)
    if project is None:
        text = "No live project has a game: there is nothing to start."
        findings.append(bad(rehearsal.CHECK, text, "Register one with --live."))
        return {}
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    if bots:
        return _play(context, project, findings, bots=bots, minutes=minutes, file=file, yes=yes)
    with _progress() as progress:
        rehearsal.rehearse(rehearsal.LoneServer(context.platform, project, progress), project, findings, context.fetch)
    return {}


@contextlib.contextmanager
def _progress() -> Iterator[rehearsal.Progress]:
    with screen.err.status("Rehearsing …") as status:
        yield lambda text: status.update(f"Rehearsing: {text}")


def _play(
    context: CheckContext,
    project: Project,
    findings: list[Finding],
    *,
    bots: int,
    minutes: int,
    file: Path | None,
    yes: bool,
) -> dict[str, Any]:
    """Ask, rehearse, and write the transcript into `file`. Raises `Problem` if the answer is no."""
    from hippodrome.deployment.operate.doctor.play import Play, estimate  # noqa: PLC0415 - bots, and what reads data
    from hippodrome.deployment.operate.doctor.transcript import Transcript  # noqa: PLC0415 - as above

    if file is not None and not file.absolute().parent.is_dir():
        raise Problem(f"There is no folder {file.parent}.", "Make it, or name another file for the transcript.")
    usd = estimate(project, bots)
    screen.info(
        f"{count(bots, 'bot')} and three servers more, about ten minutes, {minutes} at most. "
        f"It costs about ${usd.likely:.2f}, ${usd.high:.2f} at most (list prices of {REGION}). "
        f"{project.id} itself is not touched: a copy of it is registered, and removed at the end. "
        "One alarm is set off: its mail says that it is a rehearsal."
    )
    screen.confirm("Begin?", yes)
    transcript = Transcript()
    try:
        with _progress() as progress:
            Play(context, project, transcript, progress, bots=bots, minutes=minutes).run()
    finally:
        findings += transcript.findings
        document = transcript.document(context.account.region, bots)
        if file is not None:
            file.write_text(json.dumps(document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
            wrong = sum(finding.mark is Mark.BAD for finding in findings)
            screen.success(f"The transcript is in {file}: {len(transcript.proven)} things proven, {wrong} not.")
    return document


def _conclude(findings: list[Finding], rehearsed: list[Finding]) -> None:
    bads = sum(finding.mark is Mark.BAD for finding in findings)
    looks = sum(finding.mark is Mark.LOOK for finding in findings)
    succeeded = bool(rehearsed) and all(finding.mark is not Mark.BAD for finding in rehearsed)
    ready = "The rehearsal succeeded" if succeeded else "" if bads else "Ready"
    sentence = f"{bads} to mend, {looks} to look at" if bads else f"{looks} to look at" if looks else ""
    screen.out.print(Text(f"{'; '.join(filter(None, (ready, sentence)))}.", style="bold"))
