"""Removes an installation: finds what exists of it, and carries out the steps that remove it."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.control.aws.challenges import TTL
from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.certificates.rules import proof_name
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import secret_parameters
from hippodrome.deployment.core.stages import Executor, PlanStep, step
from hippodrome.deployment.operate.stop import Stopper
from hippodrome.deployment.stack import acm_records, inventory, policies
from hippodrome.deployment.stack.acm_records import Validation
from hippodrome.deployment.stack.code_bucket import CodeBucket
from hippodrome.deployment.stack.deletion import StackDeletion
from hippodrome.deployment.stack.inventory import Addresses, ListedResource, Resource
from hippodrome.deployment.stack.policies import PolicyAttachments
from hippodrome.deployment.stack.stack import Stack, ids_of

STOPPING = 180  # seconds that servers may take to stop: a task has 120 to store its recordings

_GONE = re.compile(r"NotFound|not found|does not exist|NoSuch|inactive")


@dataclass(frozen=True)
class FoundInstallation:
    """The parts of an installation that exist."""

    stack: Mapping[str, Any] | None  # as CloudFormation describes it, if it is still there
    things: Sequence[ListedResource]  # resources outside of the stack, made by the commands or left by the stack
    data: Sequence[str]  # data buckets
    installation: Installation | None  # None if the stack's outputs are not complete
    resources: Sequence[Resource] = ()  # of the stack, and of deleted stacks of its name, as CloudFormation lists them
    addresses: Sequence[Addresses] = ()  # the addresses of the same stacks
    attached: Sequence[PolicyAttachments] = ()  # to whom the stack's policies are attached

    def __bool__(self) -> bool:
        return bool(self.stack or self.things or self.data)


class Removal:
    """Removes an installation. Every step may be repeated; a step that finds nothing to do does nothing."""

    def __init__(self, account: Account, name: str, executor: Executor | None = None) -> None:
        self.account = account
        self.name = name
        self.executor = executor or Executor()
        self._stack = Stack(account, name, self.executor.sleep)
        self._code = CodeBucket(account, name)
        self.errors: list[str] = []
        self._records: list[Validation] = []
        self.kept: list[tuple[Validation, str]] = []  # records that stay, and what uses them

    def look(self) -> FoundInstallation:
        """Find what exists. Changes nothing."""
        described = self._stack.describe()
        things = [
            ListedResource("ECS task definition", arn) for arn in inventory.task_definitions(self.account, self.name)
        ]
        stack_resources = self._stack.resources() if described else []
        own = {resource.get("PhysicalResourceId") for resource in stack_resources}
        groups = inventory.log_groups(self.account, self.name)
        things += [ListedResource("log group", group) for group in groups if group not in own]
        things += [ListedResource("secret", name) for name in self._secret_names()]
        if self._code.exists():
            things.append(ListedResource("S3 bucket", self._code.name))
        attached = [policies.attached(self.account, arn) for arn in ids_of(stack_resources, "AWS::IAM::ManagedPolicy")]
        stacks = inventory.stacks(self.account, self.name)
        resources = inventory.resources(self.account, stacks)
        return FoundInstallation(
            described,
            things,
            inventory.data_buckets(self.account, self.name, resources),
            _installation(self.account, described),
            resources,
            inventory.addresses(stacks),
            [*filter(None, attached)],
        )

    def plan(self, installation: FoundInstallation, data: bool) -> list[PlanStep]:
        """Plan the steps in their order: the stack, the resources outside of it, and with `data` also the data."""
        steps: list[PlanStep] = [step(self._prepare_stack, installation.stack)] if installation.stack else []
        steps += [step(inventory.mark, self.account, bucket, self.name) for bucket in installation.data]
        steps += [step(self._remember, installation), step(self._delete_stack, installation)]
        steps += [step(self._acme_records, addresses) for addresses in installation.addresses]
        steps += [step(self._validation_records), step(self._task_definitions), step(self._log_groups)]
        steps.append(step(self._secrets))
        steps.append(step(self._bucket, self._code.name, "code"))
        return steps + ([step(self._data_buckets)] if data else [])

    def run(self, installation: FoundInstallation, data: bool) -> None:
        """Remove everything, the data only with `data`. Raises `Problem` if AWS or another resource prevents it."""
        self.executor.execute(self.plan(installation, data))

    # -- steps

    def _prepare_stack(self, described: Mapping[str, Any]) -> None:
        """Wait for the stack's present operation, unless that creates it.

        Raises `Problem` if the stack is protected, or if one of its policies is a permissions boundary.
        """
        self._stack.must_not_be_protected(described)
        for arn in self._stack.ids_of("AWS::IAM::ManagedPolicy"):
            policies.must_be_no_boundary(self.account, arn)
        if described["StackStatus"] != "CREATE_IN_PROGRESS":  # a creation may take hours, and can be deleted
            self._stack.attach()

    def _remember(self, installation: FoundInstallation) -> None:
        """Write down the validation records of the site's certificate, while ACM still knows them."""
        if not installation.stack or not installation.addresses:
            return
        arns, zone = self._stack.ids_of("AWS::CertificateManager::Certificate"), _zone(installation)
        self._records = [record for arn in arns for record in acm_records.of_certificate(self.account, arn, zone)]
        acm_records.remember(self._code, self._records)

    def _delete_stack(self, installation: FoundInstallation) -> None:
        stop_servers = partial(self._stop_servers, installation.installation)
        StackDeletion(self.account, self._stack, self.executor, stop_servers).run()
        if installation.stack:
            screen.success(f"The stack {self.name} is deleted.")

    def _stop_servers(self, installation: Installation | None) -> None:
        """Stop servers by their records, if the bucket exists; then stop all other tasks in the cluster."""
        if installation is None or not inventory.cluster_exists(self.account, installation["Cluster"]):
            return
        ecs, cluster = self.account.client("ecs"), installation["Cluster"]
        if inventory.bucket_exists(self.account, installation["Bucket"]):
            stopper = Stopper(self.account.platform(installation), executor=self.executor)
            with screen.ProgressBars() as bar:
                task = bar.add_task("Stopping servers", total=None)
                remaining = stopper.run(STOPPING, lambda stopped: bar.advance(task, stopped))
            if stopper.stopped:
                screen.success(f"{count(len(stopper.stopped), 'server')} stopped.")
            if remaining.to_do:
                self.errors.extend(stopper.errors)
        tasks = EcsTasks(lambda: ecs, lambda: self.account.client("ec2"), installation.__getitem__)

        def running() -> Sequence[str]:
            arns = tasks.arns(cluster)
            for arn in arns:
                _remove(ecs.stop_task, cluster=cluster, task=arn, reason="the installation is being removed")
            return arns

        if left_running := self.executor.wait(running, STOPPING):
            raise Problem(
                f"{count(len(left_running), 'task')} still in the cluster {cluster}.", "Run it again in a minute."
            )

    def _validation_records(self) -> None:
        """Delete the records that prove the site's name to ACM, unless another certificate needs them."""
        for record in dict.fromkeys([*self._records, *acm_records.remembered(self._code)]):
            if acm_records.present(self.account, record) is None:
                continue
            if users := acm_records.users(self.account, record):
                self.kept.append((record, ", ".join(users)))
            elif acm_records.remove(self.account, record):
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
        ecs = self.account.client("ecs")
        arns = inventory.task_definitions(self.account, self.name)
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

    def _data_buckets(self) -> None:
        resources = inventory.resources(self.account, inventory.stacks(self.account, self.name))
        for bucket in inventory.data_buckets(self.account, self.name, resources):
            self._bucket(bucket, "data")

    def _bucket(self, name: str, kind: str) -> None:
        """Delete a bucket of the account with all versions of all objects. `kind` (code or data) is for messages."""
        if not inventory.bucket_exists(self.account, name):
            return
        with screen.ProgressBars() as bar:
            task = bar.add_task(f"Emptying the {kind} bucket", total=None)
            VersionedBucket(self.account, name).empty(lambda deleted: bar.advance(task, len(deleted)))
        try:
            self.account.client("s3").delete_bucket(Bucket=name, ExpectedBucketOwner=self.account.id)
        except ClientError as error:
            if errors.code(error) == "BucketNotEmpty":
                raise Problem(f"Programs still write into {name}.", "Run the same command again.") from None
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


def _zone(installation: FoundInstallation) -> str:
    """Return the hosted zone of the present stack; without a stack, of the stack of its name that was deleted last."""
    standing = inventory.addresses([installation.stack] if installation.stack else [])
    return (standing or installation.addresses)[0].zone


def _installation(account: Account, found: Mapping[str, Any] | None) -> Installation | None:
    """Return the installation of a stack in any state; None if outputs are missing, since it was never complete."""
    installation = Installation.of(account, found) if found else None
    whole = installation and {"Cluster", "Bucket"} <= set(installation.outputs)
    return installation if whole else None
