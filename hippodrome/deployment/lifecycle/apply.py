"""Makes the stack, or brings it up to date; or plans that, and changes nothing."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from botocore.exceptions import ClientError
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.formatting import count, duration
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account, find_installation, site_host
from hippodrome.deployment.core.finding import Finding, look
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.lifecycle import plan as plans
from hippodrome.deployment.lifecycle import preflight
from hippodrome.deployment.lifecycle.plan import Plan
from hippodrome.deployment.stack import domain_change, inventory, states
from hippodrome.deployment.stack.changes import ChangeSet, Prepared, change_set, delete_old_change_sets, prepare
from hippodrome.deployment.stack.deletion import StackDeletion
from hippodrome.deployment.stack.settings import StackSettings
from hippodrome.deployment.stack.stack import Stack, role_is_new
from hippodrome.deployment.stack.states import StackAction

if TYPE_CHECKING:
    from hippodrome.deployment.core.project_folder import ProjectFolder

ROLE_PAUSE = 10  # seconds to wait until AWS knows a new role everywhere
ROLE_TRIES = 3  # attempts to make the stack
QUEUE_NAME = 70  # seconds after the deletion of a queue in which its name cannot be used: 60, and 10 to be sure
TIMERS = 300  # seconds for which a deleted schedule group may keep its name, at most


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


@dataclass(frozen=True)
class ApplyOutcome:
    """The result of an apply: whether it changed something, and the stack's outputs."""

    changed: bool
    outputs: Mapping[str, str] = field(default_factory=dict)


def plan(account: Account, name: str, settings: StackSettings, study: ProjectFolder | None = None) -> Plan:
    """Plan what `apply` would do now. Raises `Problem` if it could not begin.

    The stack is not changed. For an update, a change set is made and deleted.
    """
    prepared = prepare(account, name, settings)
    action = states.action_for(prepared.status)
    if action is StackAction.STOP:
        raise states.problem(name, prepared.status)
    if action in {StackAction.WAIT, StackAction.ROLL_BACK, StackAction.CONTINUE}:
        raise Problem(
            f"The stack {name} is in {prepared.status}.", "`hippodrome deploy` waits for its end, or takes it back."
        )
    if prepared.existing is None:
        changes = plans.of_creation(prepared.template, prepared.parameters)
        return _plan(prepared, changes, preflight.look_at(prepared, study))
    if prepared.unchanged():
        return _plan(prepared, ())
    if not prepared.bucket.exists():
        raise Problem(f"The code bucket {prepared.bucket.name} is gone.", "`hippodrome deploy` makes it anew.")
    with change_set(prepared, keep=False) as made:
        warnings = [look("CloudFormation", warning) for warning in made.warnings]
    return _plan(prepared, _changes(prepared, made), [*warnings, *preflight.look_at(prepared, study)])


def _changes(prepared: Prepared, made: ChangeSet) -> list[plans.Change]:
    return plans.of_change_set(made.changes, prepared.template)


def _plan(prepared: Prepared, changes: Sequence[plans.Change], findings: Sequence[Finding] = ()) -> Plan:
    name, region, site = prepared.stack.name, prepared.account.region, site_host(prepared.parameters)
    if not changes:
        return Plan(name, region, "nothing")
    new_site = site if site != site_host(prepared.before) else ""
    if prepared.existing is None:
        return Plan(name, region, "create", changes, findings=findings, site=new_site)
    return Plan(name, region, "update", changes, prepared.changed_parameters(), findings, new_site)


def apply(account: Account, name: str, settings: StackSettings, request: ApplyRequest = ApplyRequest()) -> ApplyOutcome:
    """Make the stack, or change it, as template and settings say, and print each step. May be repeated at any time.

    Checks first whether that can succeed, and asks before anything is lost. Raises `Problem` if a check finds an
    obstacle, the answer is no, or CloudFormation fails.
    """
    began, stack = time.monotonic(), Stack(account, name)
    stack.settle()
    try:
        prepared = _without_remains(prepare(account, name, settings))
    except Problem as problem:
        if states.action_for(stack.status) is not StackAction.UPDATE:  # a first installation: show the rest, too
            wrong = [*request.wrong, preflight.of_problem("installation", problem)]
            preflight.stop([*wrong, *preflight.look_at_account(account, request.study)])
        raise
    if not request.wrong and prepared.unchanged():
        return _unchanged(account, name)
    preflight.stop([*request.wrong, *preflight.look_at(prepared, request.study)], anyway=request.anyway)
    executor = Executor()
    if prepared.existing is None and _make_ecs_role(account):
        screen.info(f"ECS's role was made just now: {ROLE_PAUSE} seconds, until AWS knows it everywhere.")
        executor.sleep(ROLE_PAUSE)

    def wait_for_role(error: Exception) -> bool:
        if not isinstance(error, Problem) or not role_is_new(error):
            return False
        screen.info(f"AWS does not know a new role everywhere yet: once more in {ROLE_PAUSE} seconds.")
        executor.sleep(ROLE_PAUSE)
        return True

    def once() -> ApplyOutcome:
        now = replace(prepared, described=prepared.stack.describe())
        return _carry_out(_without_remains(now), request, executor, began)

    return executor.retry(once, wait_for_role, ROLE_TRIES)


def _without_remains(prepared: Prepared) -> Prepared:
    """Delete the stack if its creation failed. Return `prepared`, in which that stack does not exist any more."""
    if states.action_for(prepared.status) is not StackAction.RECREATE:
        return prepared
    screen.info(f"The stack {prepared.stack.name} is in {prepared.status}: its making failed, and nothing of it works.")
    screen.info("It is deleted and made anew.")
    StackDeletion(prepared.account, prepared.stack, Executor()).run("Deleting the failed stack")
    return replace(prepared, described=None)


def _make_ecs_role(account: Account) -> bool:
    """Make ECS's service-linked role if the account has none: without it, a template's first cluster fails.

    (aws-cloudformation/cloudformation-coverage-roadmap, issue 818.) Return whether it was made now: AWS knows it
    everywhere some seconds later (IAM's user guide, "Changes that I make are not always immediately visible").
    """
    try:
        account.client("iam").create_service_linked_role(AWSServiceName="ecs.amazonaws.com")
    except ClientError as error:
        # InvalidInput: the role exists. If these credentials may not make it, it may exist all the same.
        if errors.code(error) not in {"InvalidInput", "AccessDenied", "InvalidAction", "EntityAlreadyExists"}:
            raise
        return False
    return True


def _carry_out(prepared: Prepared, request: ApplyRequest, executor: Executor, began: float) -> ApplyOutcome:
    """Upload the functions, make a change set, ask before a loss, and execute it."""
    account, stack = prepared.account, prepared.stack
    if prepared.bucket.make():
        screen.success(f"The code bucket {prepared.bucket.name} has been made.")
    if uploaded := prepared.bucket.upload(prepared.functions):
        screen.success(f"{uploaded} of {len(prepared.functions)} functions uploaded.")
    delete_old_change_sets(prepared)
    _wait_for_names(account, stack.name, executor)  # CloudFormation refuses a change set whose names are taken
    with change_set(prepared, keep=True) as made:
        if not made.changes:
            return _unchanged(account, stack.name)
        planned = _plan(prepared, _changes(prepared, made))
        show(planned)
        for warning in made.warnings:
            screen.warning(f"CloudFormation warns of {warning}")
        if planned.dangers:
            screen.confirm("Something would be lost, as said in red. Go on?", request.yes)
        domain_change.certify(prepared)
        _execute(prepared, made)
    number = count(len(planned.changes), "change")
    screen.success(f"The stack {stack.name} is up to date: {number} in {duration(time.monotonic() - began)}.")
    return ApplyOutcome(True, dict(find_installation(account, stack.name).outputs))


def show(planned: Plan, *, answer: bool = False) -> None:
    """Print the plan: to stdout if it is the command's `answer`, else to stderr, before it is carried out."""
    console = screen.out if answer else screen.err
    for line, style in planned.lines():
        console.print(Text(line, style=style))


def _unchanged(account: Account, name: str) -> ApplyOutcome:
    screen.success(f"Nothing to do: the stack {name} in {account.region} is as it should be.")
    return ApplyOutcome(False, dict(find_installation(account, name).outputs))


def _execute(prepared: Prepared, made: ChangeSet) -> None:
    stack = prepared.stack
    after = stack.last_event(made.stack_id)
    # RetainExceptOnCreate: a creation that fails deletes its empty data bucket, too.
    prepared.account.client("cloudformation").execute_change_set(
        ChangeSetName=made.arn, StackName=made.stack_id, RetainExceptOnCreate=True
    )
    title = "Updating the stack" if prepared.existing else "Making the stack (five minutes or so)"
    status = stack.follow(title, made.stack_id, len(made.changes), after)
    if status not in states.COMPLETE:
        summary = f"The stack {stack.name} could not be {'updated' if prepared.existing else 'made'}"
        raise stack.problem(summary, made.stack_id, status)


def _wait_for_names(account: Account, name: str, executor: Executor) -> None:
    """Wait until the names of an earlier stack's timers and queues are free again.

    EventBridge Scheduler: a deleted group is in the state DELETING until its schedules are deleted (user guide,
    "Deleting a schedule group"). SQS: "you must wait at least 60 seconds before creating a queue with the same name"
    (API reference, DeleteQueue); otherwise the stack rolls back, which deletes queues once more.
    """

    def deleting() -> bool:
        try:
            return bool(account.client("scheduler").get_schedule_group(Name=name)["State"] == "DELETING")
        except ClientError:  # there is none, or these credentials may not look: CloudFormation will say
            return False

    executor.wait(deleting, TIMERS, pause=5, title="EventBridge is still deleting the timers of an earlier stack")
    deleted = [stack["DeletionTime"] for stack in inventory.summaries(account, name) if "DeletionTime" in stack]
    since = (datetime.now(UTC) - max(deleted)).total_seconds() if deleted else QUEUE_NAME
    if since < QUEUE_NAME:
        seconds = min(QUEUE_NAME, round(QUEUE_NAME - since))
        screen.info(f"AWS keeps the names of deleted queues for a minute: {seconds} seconds.")
        executor.sleep(seconds)
