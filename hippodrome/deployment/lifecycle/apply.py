"""`deploy apply`: makes the stack, or brings it up to date."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.formatting import count, duration
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.code import bytecode
from hippodrome.deployment.core import options
from hippodrome.deployment.core.finding import Finding
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.lifecycle import plan as plans
from hippodrome.deployment.lifecycle import preflight
from hippodrome.deployment.stack import cooldown, domain_change, states
from hippodrome.deployment.stack.changes import PREFIX, Prepared, change_set, prepare
from hippodrome.deployment.stack.deletion import StackDeletion
from hippodrome.deployment.stack.settings import StackSettings, taking_settings
from hippodrome.deployment.stack.stack import Stack, role_is_new

if TYPE_CHECKING:
    from hippodrome.deployment.core.project_folder import ProjectFolder

ROLE_PAUSE = 10  # seconds to wait until AWS knows a new role everywhere
ROLE_TRIES = 3  # attempts to make the stack


def _suggest_python(python: str | None) -> None:
    """Suggest installing `python`, the functions' version, which compiles the zips' bytecode, if it is missing."""
    if python and bytecode.compiler(python) is None:
        screen.info(
            f"With Python {python} on this machine, functions would start about a fifth faster. It is not needed."
        )


@dataclass(frozen=True)
class ApplyOutcome:
    """The result of an apply: whether it changed something, how many seconds it took, and the stack's outputs."""

    changed: bool
    seconds: float
    created: bool = False
    outputs: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class ApplyRequest:
    """What `apply` has to know beside the settings: the study, earlier findings, and the administrator's answers.

    `study` will be registered after the apply; `wrong` are bad findings about it. `yes` agrees to every loss. With
    `anyway`, bad findings do not stop the apply.
    """

    study: ProjectFolder | None = None
    wrong: Sequence[Finding] = ()
    yes: bool = False
    anyway: bool = False


def apply(
    account: Account,
    stack: str,
    settings: StackSettings,
    request: ApplyRequest = ApplyRequest(),
) -> ApplyOutcome:
    """Make the stack, or change it, as template and settings say, and print each step. May be repeated at any time.

    Checks first whether that can succeed, and asks before anything is lost. Raises `Problem` if a check finds an
    obstacle, the answer is no, or CloudFormation fails.
    """
    began = time.monotonic()
    Stack(account, stack).settle()
    prepared = _without_remains(_prepare(account, stack, settings, request))
    if not request.wrong and prepared.unchanged():
        return _unchanged(account, stack, began)
    preflight.check(prepared, request.study, request.wrong, anyway=request.anyway)
    if prepared.existing is None and preflight.make_ecs_role(account):
        screen.info(f"ECS's role was made just now: {ROLE_PAUSE} seconds, until AWS knows it everywhere.")
        time.sleep(ROLE_PAUSE)
    executor = Executor()

    def wait_for_role(error: Exception) -> bool:
        if not isinstance(error, Problem) or not role_is_new(error):
            return False
        screen.info(f"AWS does not know a new role everywhere yet: once more in {ROLE_PAUSE} seconds.")
        executor.sleep(ROLE_PAUSE)
        return True

    def once() -> ApplyOutcome:
        now = replace(prepared, found=prepared.stack.describe())
        return _carry_out(_without_remains(now), request, began)

    return executor.retry(once, wait_for_role, ROLE_TRIES)


def _prepare(account: Account, stack: str, settings: StackSettings, request: ApplyRequest) -> Prepared:
    """Call `prepare`. If it fails before a first installation, show the other findings on the account, too."""
    try:
        return prepare(account, stack, settings)
    except Problem as problem:
        if states.action_for(Stack(account, stack).status) is states.StackAction.UPDATE:
            raise
        preflight.check_account(account, [*request.wrong, preflight.of_problem("installation", problem)], request.study)
        raise


def _without_remains(prepared: Prepared) -> Prepared:
    """Delete the stack if its creation failed. Return `prepared`, in which that stack does not exist any more."""
    if not states.never_complete(prepared.status):
        return prepared
    _delete_failed(prepared)
    return replace(prepared, found=None)


def _carry_out(prepared: Prepared, request: ApplyRequest, began: float) -> ApplyOutcome:
    """Upload the functions, make a change set, ask before a loss, and execute it."""
    account, stack = prepared.account, prepared.stack.name
    if prepared.bucket.make():
        screen.success(f"The code bucket {prepared.bucket.name} has been made.")
    uploaded = prepared.bucket.upload(prepared.functions)
    if uploaded:
        screen.success(f"{uploaded} of {len(prepared.functions)} functions uploaded.")
        _suggest_python(prepared.functions[0].python)
    _delete_old_change_sets(prepared)
    cooldown.wait(account, stack)  # CloudFormation refuses a name in use as soon as it makes the change set
    with change_set(prepared, keep=True) as made:
        if not made.changes:
            return _unchanged(account, stack, began)
        changes = plans.of_change_set(made.changes, prepared.template)
        kind = "update" if prepared.existing else "create"
        changed = prepared.changed_parameters() if prepared.existing else {}
        plan = plans.Plan(stack, account.region, kind, changes, changed, site=plans.new_site(prepared))
        plans.show(plan)
        for warning in made.warnings:
            screen.warning(f"CloudFormation warns of {warning}")
        if plan.dangers:
            screen.confirm("Something would be lost, as said in red. Go on?", request.yes)
        domain_change.certify(prepared)
        _execute(prepared, made.arn, made.stack_id, len(changes))
    installation = find_installation(account, stack)
    seconds = time.monotonic() - began
    screen.success(f"The stack {stack} is up to date: {count(len(changes), 'change')} in {duration(seconds)}.")
    return ApplyOutcome(True, seconds, prepared.existing is None, dict(installation.outputs))


def _unchanged(account: Account, stack: str, began: float) -> ApplyOutcome:
    seconds = time.monotonic() - began
    screen.success(f"Nothing to do: the stack {stack} in {account.region} is as it should be ({seconds:.1f} s).")
    return ApplyOutcome(False, seconds, outputs=dict(find_installation(account, stack).outputs))


def _delete_failed(prepared: Prepared) -> None:
    """Delete a stack whose creation failed, so that it can be made anew, and its buckets if they are empty."""
    stack, existing = prepared.stack, prepared.found
    assert existing
    screen.info(f"The stack {stack.name} is in {prepared.status}: its making failed, and nothing of it works.")
    screen.info("It is deleted and made anew.")
    buckets = [
        resource["PhysicalResourceId"]
        for resource in stack.resources()
        if resource["ResourceType"] == "AWS::S3::Bucket"
    ]
    StackDeletion(prepared.account, stack, Executor()).run("Deleting the failed stack")
    s3 = prepared.account.client("s3")
    for bucket in filter(None, buckets):
        try:
            s3.delete_bucket(Bucket=bucket, ExpectedBucketOwner=prepared.account.id)
        except ClientError as error:
            code = errors.code(error)
            if code == "BucketNotEmpty":
                screen.warning(f"The bucket {bucket} of the failed stack is not empty, so it is not deleted.")
            elif code not in {"NoSuchBucket", "404"}:
                raise


def _delete_old_change_sets(prepared: Prepared) -> None:
    """Delete change sets that an interrupted run left behind."""
    if not prepared.found:
        return
    client = prepared.account.client("cloudformation")
    try:
        for page in client.get_paginator("list_change_sets").paginate(StackName=prepared.stack.name):
            for summary in page["Summaries"]:
                if (
                    summary["ChangeSetName"].startswith(PREFIX)
                    and summary.get("ExecutionStatus") != "EXECUTE_IN_PROGRESS"
                ):
                    client.delete_change_set(ChangeSetName=summary["ChangeSetId"], StackName=prepared.stack.name)
    except ClientError as error:
        if errors.code(error) != "ValidationError":  # the stack does not exist any more
            raise


def _execute(prepared: Prepared, arn: str, stack_id: str, total: int) -> None:
    stack = prepared.stack
    after = stack.last_event(stack_id)
    # RetainExceptOnCreate: a creation that fails deletes its empty data bucket, too.
    prepared.account.client("cloudformation").execute_change_set(
        ChangeSetName=arn, StackName=stack_id, RetainExceptOnCreate=True
    )
    title = "Updating the stack" if prepared.existing else "Making the stack (five minutes or so)"
    status = stack.follow(title, stack_id, total, after)
    if status in states.COMPLETE:
        return
    summary = f"The stack {stack.name} could not be {'updated' if prepared.existing else 'made'}"
    raise stack.problem(summary, stack_id, status)


@taking_settings
def command(
    *,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
    settings: StackSettings,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    anyway: options.Anyway = False,
    as_json: options.Json = False,
) -> int:
    """Make the installation, or bring it up to date with this folder's template and code.

    Options that are left out stay as they are. Asks only before something would be lost.
    """
    account = open_account(profile, region)
    if dry_run:
        return plans.run(account, stack, settings, as_json)
    outcome = apply(account, stack, settings, ApplyRequest(yes=yes, anyway=anyway))
    report(outcome, settings, as_json)
    return Exit.DONE


def report(outcome: ApplyOutcome, settings: StackSettings, as_json: bool) -> None:
    """Print the outcome: the participants' address, the researchers' policy, and whether a mail has to be confirmed."""
    if as_json:
        answer: dict[str, Any] = {"changed": outcome.changed, "seconds": round(outcome.seconds, 1)}
        screen.result_json(answer | {"outputs": dict(outcome.outputs)})
        return
    if site := outcome.outputs.get("Site"):
        screen.result(f"{site}/next is where participants will go.")
    if policy := outcome.outputs.get("ResearcherPolicy"):
        screen.result(f"{policy} is the policy that researchers need.")
    if settings.email and outcome.changed:
        screen.warning(f"AWS has sent a mail to {settings.email}: alarms come only after its link has been clicked.")
