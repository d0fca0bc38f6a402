"""`hippodrome destroy`: removes the installation, and lists what stays. Without --data, participants' data stay."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, NamedTuple

import typer
from botocore.exceptions import ClientError
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors
from hippodrome.control.aws.challenges import TTL
from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.certificates.rules import proof_name
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account, Installation, elsewhere, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import options, secret_parameters
from hippodrome.deployment.core.stages import Executor, PlanStep, step
from hippodrome.deployment.operate.stop import Stopper
from hippodrome.deployment.stack import acm_records, inventory, retained_bucket
from hippodrome.deployment.stack.acm_records import Validation
from hippodrome.deployment.stack.code_bucket import CodeBucket
from hippodrome.deployment.stack.deletion import StackDeletion
from hippodrome.deployment.stack.inventory import Addresses
from hippodrome.deployment.stack.stack import Stack

STOPPING = 180  # seconds that servers may take to stop: a task has 120 to store its recordings
ROUNDS = 3  # times that everything is removed, if a look afterwards finds more: a function may write its log group anew
PAUSE = 20  # seconds between two rounds; AWS lists some deleted resources for so long

_GONE = re.compile(r"NotFound|not found|does not exist|NoSuch|inactive")


class Thing(NamedTuple):
    """A resource outside of the stack: its kind, in words, and its name."""

    kind: str
    name: str


@dataclass(frozen=True)
class Found:
    """The parts of an installation that exist."""

    stack: Mapping[str, Any] | None  # as CloudFormation describes it, if it is still there
    things: Sequence[Thing]  # outside of the stack, made by the commands or left by the stack
    data: Sequence[str]  # data buckets
    installation: Installation | None  # None if the stack's outputs are not complete
    addresses: Sequence[Addresses] = ()  # of the stack, and of deleted stacks of its name

    def to_do(self, data: bool) -> bool:
        """Whether there is something to remove; `data`: participants' data are to be removed, too."""
        return bool(self.stack or self.things or (data and self.data))

    def show(self, data: bool) -> None:
        """Print what will be removed, and what stays."""
        if self.stack:
            screen.info(f"  - the stack, {self.stack['StackStatus']}, with all that it made", "red")
        for kind in dict.fromkeys(thing.kind for thing in self.things):
            names = [thing.name for thing in self.things if thing.kind == kind]
            screen.info(f"  - {kind}: {names[0] if len(names) == 1 else len(names)}", "red")
        for bucket in self.data:
            if data:
                screen.info(f"  - the participants' data: the bucket {bucket}, every version", "bold red")
            else:
                screen.info(f"  = the participants' data stay: the bucket {bucket}")
        if data and self.data:
            screen.info(
                "  The servers' certificate goes with the data. Let's Encrypt issues five for a domain in a week; "
                "without --data the next installation takes it over."
            )


class Removal:
    """Removes an installation. Every step may be repeated; a step that finds nothing to do does nothing."""

    def __init__(self, account: Account, name: str, executor: Executor | None = None) -> None:
        self.account = account
        self.name = name
        self.executor = executor or Executor()
        self._stack = Stack(account, name, self.executor.sleep)
        self._code = CodeBucket(account, name)
        self._records: list[Validation] = []

    def look(self) -> Found:
        """Find what exists. Changes nothing."""
        described = self._stack.describe()
        own = {resource.get("PhysicalResourceId") for resource in self._stack.resources()} if described else set()
        things = [Thing("ECS task definition", arn) for arn in inventory.task_definitions(self.account, self.name)]
        groups = inventory.log_groups(self.account, self.name)
        things += [Thing("log group", group) for group in groups if group not in own]
        things += [Thing("secret", name) for name in self._secret_names()]
        if self._code.exists():
            things.append(Thing("S3 bucket", self._code.name))
        stacks = [*inventory.stacks(self.account, self.name)]
        data = inventory.data_buckets(self.account, self.name, inventory.buckets_of(self.account, stacks))
        whole = Installation.of(self.account, described) if described else None
        if whole and not {"Cluster", "Bucket"} <= set(whole.outputs):  # the stack was never complete
            whole = None
        return Found(described, things, data, whole, inventory.addresses(stacks))

    def run(self, found: Found, data: bool) -> Found:
        """Remove everything, the data only with `data`; return what a last look finds.

        Raises `Problem` if AWS or another resource prevents it.
        """
        for _ in range(ROUNDS):
            self.executor.execute(self.plan(found, data))
            found = self.look()
            if not found.to_do(data):
                break
            self.executor.sleep(PAUSE)
        return found

    def plan(self, found: Found, data: bool) -> list[PlanStep]:
        """Plan the steps in their order: the stack, the resources outside of it, and with `data` also the data."""
        steps = [step(self._prepare_stack, found.stack), step(self._remember, found)] if found.stack else []
        steps += [step(inventory.mark, self.account, bucket, self.name) for bucket in found.data]
        steps += [step(self._delete_stack, found)]
        steps += [step(self._acme_records, addresses) for addresses in found.addresses]
        steps += [step(self._validation_records), step(self._task_definitions), step(self._log_groups)]
        steps += [step(self._secrets), step(self._bucket, self._code.name, "code")]
        return steps + ([step(self._bucket, bucket, "data") for bucket in found.data] if data else [])

    # -- steps

    def _prepare_stack(self, described: Mapping[str, Any]) -> None:
        """Wait for the stack's present operation, unless that creates it. Raises `Problem` if it is protected."""
        self._stack.must_not_be_protected(described)
        if described["StackStatus"] != "CREATE_IN_PROGRESS":  # a creation may take hours, and can be deleted
            self._stack.attach()

    def _remember(self, found: Found) -> None:
        """Write down the validation records of the site's certificate, while ACM still knows them."""
        if found.addresses:
            arns, zone = self._stack.ids_of("AWS::CertificateManager::Certificate"), found.addresses[0].zone
            self._records = [record for arn in arns for record in acm_records.of_certificate(self.account, arn, zone)]
            acm_records.remember(self._code, self._records)

    def _delete_stack(self, found: Found) -> None:
        stop_servers = partial(self._stop_servers, found.installation)
        StackDeletion(self.account, self._stack, self.executor, stop_servers).run()
        if found.stack:
            screen.success(f"The stack {self.name} is deleted.")

    def _stop_servers(self, installation: Installation | None) -> None:
        """Stop servers by their records, if the bucket exists; then stop all tasks that are left in the clusters.

        Raises `Problem` if a task is left: once the stack is gone, nothing would stop it.
        """
        if installation is None or not inventory.cluster_exists(self.account, installation["Cluster"]):
            return
        ecs, clusters = self.account.client("ecs"), {installation["Cluster"]}
        if inventory.bucket_exists(self.account, installation["Bucket"]):
            stopper = Stopper(self.account.platform(installation), executor=self.executor)
            with screen.ProgressBars() as bar:
                task = bar.add_task("Stopping servers", total=None)
                remaining = stopper.run(STOPPING, lambda stopped: bar.advance(task, stopped))
            if stopper.stopped:
                screen.success(f"{count(len(stopper.stopped), 'server')} stopped.")
            for error in stopper.errors if remaining.to_do else ():
                screen.warning(error)
            clusters |= {
                server.name for server in remaining.servers
            }  # a participant's own cluster has the server's name
            clusters |= {task.cluster for task in remaining.leftovers.tasks}
        tasks = EcsTasks(lambda: ecs, lambda: self.account.client("ec2"), installation.__getitem__)

        def running() -> Sequence[str]:
            left = [(cluster, arn) for cluster in sorted(clusters) for arn in tasks.arns(cluster)]
            for cluster, arn in left:
                _remove(ecs.stop_task, cluster=cluster, task=arn, reason="the installation is being removed")
            return [cluster for cluster, _ in left]

        if left_running := self.executor.wait(running, STOPPING):
            raise Problem(
                f"{count(len(left_running), 'task')} still in {', '.join(dict.fromkeys(left_running))}.",
                "Run it again in a minute.",
            )

    def _validation_records(self) -> None:
        """Delete the records that prove the site's name to ACM, unless another certificate needs them."""
        for record in dict.fromkeys([*self._records, *acm_records.remembered(self._code)]):
            if acm_records.present(self.account, record) is None or acm_records.users(self.account, record):
                continue
            if acm_records.remove(self.account, record):
                screen.success(f"The DNS record {record.name} is deleted, which proved the site's name to AWS.")

    def _acme_records(self, addresses: Addresses) -> None:
        """Delete the challenge records that interrupted orders of certificates left."""
        name, zone, client = proof_name(addresses.servers), addresses.zone, self.account.client("route53")
        try:
            answer = client.list_resource_record_sets(HostedZoneId=zone, StartRecordName=f"{name}.", MaxItems="10")
        except client.exceptions.NoSuchHostedZone:
            return
        for record in answer["ResourceRecordSets"]:
            if record["Name"].rstrip(".") == name and record["Type"] == "TXT" and record.get("TTL") == TTL:
                batch = acm_records.deletion(record)
                _remove(client.change_resource_record_sets, HostedZoneId=zone, ChangeBatch=batch)

    def _task_definitions(self) -> None:
        ecs, arns = self.account.client("ecs"), inventory.task_definitions(self.account, self.name)
        if not arns:
            return
        with screen.ProgressBars() as bar:
            task = bar.add_task("Removing task definitions", total=len(arns))
            for start in range(0, len(arns), 10):  # DeleteTaskDefinitions takes ten at a time
                chunk = arns[start : start + 10]
                for arn in chunk:
                    _remove(ecs.deregister_task_definition, taskDefinition=arn)
                _remove(ecs.delete_task_definitions, taskDefinitions=chunk)
                bar.advance(task, len(chunk))

    def _log_groups(self) -> None:
        for group in inventory.log_groups(self.account, self.name):
            _remove(self.account.client("logs").delete_log_group, logGroupName=group)

    def _secret_names(self) -> list[str]:
        stored = secret_parameters.stored(self.account, self.name)
        return [resource_names.secret(self.name, name) for name in stored]

    def _secrets(self) -> None:
        for name in self._secret_names():
            _remove(self.account.client("ssm").delete_parameter, Name=name)

    def _bucket(self, name: str, kind: str) -> None:
        """Delete a bucket of the account with all versions of all objects. `kind` (code or data) is for messages.

        If something is written into it meanwhile, it stays until the next round.
        """
        if not inventory.bucket_exists(self.account, name):
            return
        with screen.ProgressBars() as bar:
            task = bar.add_task(f"Emptying the {kind} bucket", total=None)
            VersionedBucket(self.account, name).empty(lambda deleted: bar.advance(task, len(deleted)))
        try:
            self.account.client("s3").delete_bucket(Bucket=name, ExpectedBucketOwner=self.account.id)
        except ClientError as error:
            if errors.code(error) == "BucketNotEmpty":  # a server's last recording, or a browser's late request
                screen.info(f"Something was written into {name} meanwhile.")
                return
            if errors.code(error) != "NoSuchBucket":
                raise
        screen.success(f"The {kind} bucket {name} is deleted.")


def _remove(call: Callable[..., Any], **arguments: Any) -> None:
    """Make the call, and ignore an error that says that the resource is gone already."""
    try:
        call(**arguments)
    except ClientError as error:
        if not _GONE.search(f"{errors.code(error)} {errors.message(error)}"):
            raise


# -- the command


def command(
    *,
    data: Annotated[bool, typer.Option("--data", help="Delete the participants' data as well, all versions.")] = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    as_json: options.Json = False,
) -> int:
    """Remove the installation: servers, stack, images, task definitions, code, logs. The data stay without --data.

    Run it again after any interruption. At the end it lists what AWS still has of it.
    """
    account = open_account(profile, region)
    account.id  # noqa: B018 - raises at once if AWS does not accept the credentials
    removal = Removal(account, stack)
    screen.info(f"Looking for the resources of {stack} in {account.region} …", "dim")
    found = removal.look()
    if not (found.stack or found.things or found.data):
        screen.result(f"There is nothing of {stack} in {account.region}.")
        if hint := elsewhere(account, stack):
            screen.warning(hint)
        return Exit.DONE
    if not (dry_run and as_json):
        found.show(data)
    if not dry_run and found.to_do(data):
        _ask(stack, data and bool(found.data), yes)
        found = removal.run(found, data)
    kept = _look_for_kept(account, found)
    if as_json:
        screen.result_json(_as_json(found, kept))
    if dry_run:
        return Exit.CHANGES if found.to_do(data) else Exit.DONE
    if found.to_do(data):
        raise Problem(
            f"Something is left of {stack} in {account.region}.",
            "Run the same command again.",
            [
                *([f"stack: {stack}"] if found.stack else []),
                *(f"{thing.kind}: {thing.name}" for thing in found.things),
                *(f"S3 bucket: {bucket}" for bucket in found.data if data),
            ],
        )
    kept.show()
    screen.success(f"Nothing{' else' if kept or found.data else ''} is left of {stack} in {account.region}.")
    _tell_data(account, stack, found.data, options.same_place(account.region, profile))
    return Exit.DONE


def _ask(stack: str, data: bool, yes: bool) -> None:
    if yes:
        return
    extent = "everything, the participants' data included" if data else "all of this"
    if not sys.stdin.isatty():
        advice = "Add --yes to go on without."
        raise Problem(f"There is no terminal in which to type {stack}.", advice, exit_code=Exit.DECLINED)
    screen.err.print(Text(f"To remove {extent}, type the stack's name: "), end="")
    if screen.read_line() != stack:
        raise Problem("Nothing was removed.", exit_code=Exit.DECLINED)


# -- what stays


@dataclass(frozen=True)
class Kept:
    """What stays in the zone of a removed stack."""

    records: Sequence[tuple[Validation, str, str]] = ()  # the site's, with the reason, and the command that deletes it
    server_names: Sequence[str] = ()  # of this or another installation of the same domain

    def __bool__(self) -> bool:
        return bool(self.records or self.server_names)

    def show(self) -> None:
        """Print why they stay, and how to delete them."""
        for record, why, remove in self.records:
            screen.warning(f"The DNS record {record.name} stays: {why}. To delete it:")
            screen.info(f"  {remove}")
        if names := self.server_names:
            screen.warning(
                f"{count(len(names), 'name')} of servers are in the zone ({', '.join(names[:3])}): another "
                "installation's with the same domain, or left over. If there is no other, delete them in Route 53: AWS "
                "may have given their addresses to others."
            )


def _look_for_kept(account: Account, found: Found) -> Kept:
    if found.stack:
        return Kept()
    records = []
    for addresses in found.addresses:
        for record in acm_records.of_domain(account, addresses.zone, addresses.site):
            users = ", ".join(acm_records.users(account, record))
            why = f"it renews {users}" if users else "it may prove the name for another AWS account"
            if present := acm_records.present(account, record):
                records.append((record, why, acm_records.removal(record.zone, present)))
    names = [name for addresses in found.addresses for name in inventory.server_names(account, addresses)]
    return Kept(records, names)


def _as_json(found: Found, kept: Kept) -> dict[str, Any]:
    return {
        "stack": found.stack["StackStatus"] if found.stack else None,
        "things": [thing._asdict() for thing in found.things],
        "data": list(found.data),
        "records": [{"name": record.name, "why": why, "remove": remove} for record, why, remove in kept.records],
        "serverNames": list(kept.server_names),
    }


def _tell_data(account: Account, stack: str, buckets: Sequence[str], place: str) -> None:
    """Print how to fetch or delete the data that stay; `place` are the options for this account and region."""
    for bucket in buckets:
        if projects := retained_bucket.projects(account, bucket):
            screen.info(f"The participants' data stay in the bucket {bucket}. To fetch them:")
            for project in projects:
                screen.info(f"  hippodrome data {project} --bucket {bucket} {place}")
        else:
            screen.info(f"The bucket {bucket} stays; nobody's data are in it. S3 keeps deleted data for 30 days.")
    if buckets:
        screen.info("To delete what stays:")
        screen.info(f"  hippodrome destroy --stack {stack} --data {place}")
