"""`hippodrome deploy`: puts the installation, its certificate and a study on AWS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors
from hippodrome.control.certificates.rules import PRODUCTION, STAGING, Verdict
from hippodrome.control.config import ConfigErrors, layout, read_project
from hippodrome.deployment.aws.account import Account, describe_stack, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import explain, options, project_folder
from hippodrome.deployment.core.explain import DENIED
from hippodrome.deployment.core.finding import Finding, show
from hippodrome.deployment.lifecycle import apply as applying
from hippodrome.deployment.lifecycle import preflight
from hippodrome.deployment.lifecycle.apply import ApplyRequest
from hippodrome.deployment.lifecycle.plan import Plan
from hippodrome.deployment.stack import certificate, certificate_transfer
from hippodrome.deployment.stack.certificate import Choice, Report
from hippodrome.deployment.stack.settings import StackSettings, taking_settings
from hippodrome.deployment.study import register


def may_apply(account: Account, stack: str) -> bool:
    """Whether these are an administrator's credentials. If there is no installation, they count as such."""
    found = describe_stack(account, stack)
    if found is None or found["StackStatus"] == "REVIEW_IN_PROGRESS":
        return True
    try:
        account.client("cloudformation").get_template(StackName=stack)
    except ClientError as error:
        if errors.code(error) in DENIED:
            return False
        raise
    return True


def study_in(folder: Path) -> project_folder.ProjectFolder | None:
    """Read the project in the folder. Return None without one, or with `useAWS: false`.

    Raises `Problem` on mistakes.
    """
    if folder.is_dir() and not layout.has_config(folder):
        screen.info(f"{folder} has no config.yml, so no study is registered.")
        return None
    try:
        config = read_project(folder)
    except ConfigErrors:
        return project_folder.read(folder)  # raises `Problem` with all of them
    if config.project.keeps_off_aws:
        screen.warning(
            f"The study {config.project.id} stays on one machine, as its config.yml says (useAWS: false); "
            "to put it on AWS, write true."
        )
        return None
    return project_folder.read(folder)


def certify(account: Account, stack: str) -> Report:
    """Order the servers' certificate if it is due. Before the first real certificate, a test certificate is ordered.

    A certificate that was uploaded by hand stays. A certificate of another authority is renewed there. Raises `Problem`
    if an order fails.
    """
    installation = find_installation(account, stack)
    certificate_transfer.take_over(account, installation)
    now = certificate.inspect(account, installation)
    if now.decision.verdict is Verdict.FOREIGN or (now.stored and now.directory not in {"", STAGING, PRODUCTION}):
        is_due = now.decision.verdict is Verdict.ORDER
        return certificate.obtain_visibly(account, installation, Choice()) if is_due else now
    if not now.stored:
        screen.info("First comes a test certificate, which shows whether a real one can be ordered.")
        certificate.obtain_visibly(account, installation, Choice(STAGING))
    return certificate.obtain_visibly(account, installation, Choice(PRODUCTION))


@taking_settings
def command(
    folder: options.Folder = Path(),
    *,
    no_certificate: Annotated[
        bool,
        typer.Option("--no-certificate", help="Order no certificate for servers now; until then no game works."),
    ] = False,
    no_study: Annotated[bool, typer.Option("--no-study", help="Register no study: only the installation.")] = False,
    base: register.Base = "",
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
    settings: StackSettings,
    plan: Annotated[
        bool,
        typer.Option("--plan", "--dry-run", help="Show what would change, and change nothing. Exit code 3: something."),
    ] = False,
    yes: options.Yes = False,
    anyway: options.Anyway = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --plan: the answer as JSON, for scripts.")] = False,
) -> int:
    """Put everything on AWS: the installation, its certificate, and the study. What is there already stays.

    Run it again after an update of Hippodrome, or to change a setting; options that are left out stay as they are. It
    asks only before something would be lost.

    Without --domain the site has AWS's own address, and each server gets a certificate for its own. A domain (with a
    hosted zone in Route 53) gives both names, and is better for large studies. For researchers, who may not change the
    installation, it only registers the study.
    """
    study, problem = (None, None) if no_study else _study(folder)
    earlier_findings = [preflight.of_problem("study", problem)] if problem else []
    account = _account(profile, region, earlier_findings)
    if problem and (plan or describe_stack(account, stack)):
        raise problem  # with an installation, the account needs no further check
    if plan:
        return _plan(applying.plan(account, stack, settings, study), as_json)
    screen.info(f"In account {account.id}, region {account.region}, as {account.identity['Arn'].rpartition(':')[2]}.")
    if may_apply(account, stack):
        request = ApplyRequest(study, earlier_findings, yes=yes, anyway=anyway)
        outcome = applying.apply(account, stack, settings, request)
        if outcome.changed:
            _report(outcome.outputs, settings.email)
        if not no_certificate and (settings.domain or outcome.outputs.get("RootDomain")):
            _certify(account, stack, study)
    else:
        screen.info(f"The installation {stack} stays as it is: these credentials are a researcher's.")
    if study is None:
        return Exit.DONE
    return register.command(folder, base=base, yes=yes, stack=stack, region=region, profile=profile)


def _study(folder: Path) -> tuple[project_folder.ProjectFolder | None, Problem | None]:
    """Return the study in the folder (None if there is none for AWS), and no problem.

    After a mistake return None and the problem, which a first installation shows together with its other problems.
    """
    try:
        return study_in(folder), None
    except Problem as problem:
        return None, problem


def _account(profile: str | None, region: str | None, findings: list[Finding]) -> Account:
    """Open the account and try its credentials. If they fail, show the findings first, then raise."""
    try:
        account = open_account(profile, region)
        account.id  # noqa: B018 - raises at once if AWS does not accept the credentials
    except Exception as error:
        if problem := explain.problem_from(error):
            show(findings, screen.err)
            raise problem from None
        raise
    return account


def _plan(planned: Plan, as_json: bool) -> int:
    """Print the plan with its findings, and return the command's exit code."""
    if as_json:
        screen.result_json(planned.as_json())
    else:
        applying.show(planned, answer=True)
        show(planned.findings, screen.err)
    return Exit.DONE if planned.kind == "nothing" else Exit.CHANGES


def _report(outputs: Mapping[str, str], email: str | None) -> None:
    """Print the participants' address, the researchers' policy, and whether a mail has to be confirmed."""
    if site := outputs.get("Site"):
        screen.result(f"{site}/next is where participants will go.")
    if policy := outputs.get("ResearcherPolicy"):
        screen.result(f"{policy} is the policy that researchers need.")
    if email:
        screen.warning(f"AWS has sent a mail to {email}: alarms come only after its link has been clicked.")


def _certify(account: Account, stack: str, found: project_folder.ProjectFolder | None) -> None:
    try:
        report = certify(account, stack)
    except Problem as problem:
        if found is None or found.plays:
            raise Problem(
                f"The installation stands, but has no certificate. {problem}",
                problem.advice or "Run the same command again.",
                problem.details,
            ) from None
        screen.warning(f"There is no certificate for servers, which this study does not need. {problem}")
    else:
        days = f", {report.days_left} days left" if report.days_left is not None else ""
        screen.success(f"The certificate for servers below {report.domain} is in place{days}.")
