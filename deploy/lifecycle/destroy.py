"""`deploy destroy`: away with all of it, proven by listing. Participants' data stay unless told otherwise."""

from __future__ import annotations

import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import typer
from botocore.exceptions import ClientError
from rich.text import Text

from console import screen
from console.problem import Exit, Problem
from console.words import count, duration, size
from deploy.aws.account import STACK, Account, Installation, elsewhere, open_account
from deploy.core import options
from deploy.cost.prices import Prices
from deploy.operate.stop import Stopper, leaving
from deploy.stack import inventory, kept_bucket, policies, validation
from deploy.stack.code_bucket import CodeBucket
from deploy.stack.inventory import Addresses, Thing
from deploy.stack.obstacles import Wait, wait_for, waits
from deploy.stack.policies import Attached
from deploy.stack.stack import Failure, NotDeleted, Stack
from deploy.stack.validation import Validation
from hippodrome.aws import errors
from hippodrome.aws.challenges import TTL
from hippodrome.certificates.rules import names_of

STOPPING = 180  # seconds that servers may take: a task has 120 to save what it has
ROUNDS = 8  # how often what is in the way is waited for, and the deletion tried again
PAUSE = 20  # seconds between two looks at what is in the way
IN_USE = 75 * 60
"""Seconds that a certificate may stay in use after API Gateway's domain is gone: 10 to 60 minutes are reported
(aws/aws-cdk issues 36265 and 16608; amplify-education/serverless-domain-manager issue 32)."""
DISAGREEING = 5 * 60  # seconds to wait when a certificate is refused as in use, and nothing is told that uses it
ADDRESSES = 25 * 60
"""Seconds that the network interfaces of tasks that have ended may stay: 5 to 20 minutes are reported
(alchemy-run/alchemy pull request 1125)."""
OLD_VERSIONS = 30  # days that the data bucket keeps versions that are not current (the template's lifecycle rule)
LISTED = 180
"""Seconds that AWS may list what is deleted: a queue up to 60 (SQS API reference, DeleteQueue), a schedule group until
its schedules are deleted (EventBridge Scheduler user guide), buckets and event source mappings for a while."""

_GONE = re.compile(r"NotFound|not found|does not exist|NoSuch|inactive")


@dataclass(frozen=True)
class Survey:
    """What there is of an installation."""

    found: Mapping[str, Any] | None  # the stack, if it is still there
    things: Sequence[Thing]  # what the commands made beside it, and what it left
    data: Sequence[str]  # data buckets
    installation: Installation | None  # if its outputs are known
    addresses: Sequence[Addresses] = ()  # of the stack, and of those of its name that were deleted
    attached: Sequence[Attached] = ()  # whom the stack's policies are attached to

    def __bool__(self) -> bool:
        return bool(self.found or self.things or self.data)


class Destroyer:
    """Takes an installation away, step by step; every step may be repeated, and finds done what is done."""

    def __init__(self, account: Account, name: str, sleep: Callable[[float], None] | None = None) -> None:
        self.account = account
        self.name = name
        self.sleep = sleep or time.sleep
        self._stack = Stack(account, name, self.sleep)
        self._code = CodeBucket(account, name)
        self.errors: list[str] = []
        self._records: list[Validation] = []
        self.kept: list[tuple[Validation, str]] = []  # records that stay, and who uses them

    def survey(self) -> Survey:
        """Look; changes nothing."""
        found = self._stack.describe()
        things = [Thing("ECS task definition", arn) for arn in inventory.task_definitions(self.account, self.name)]
        resources = self._stack.resources() if found else []
        own = {one.get("PhysicalResourceId") for one in resources}
        groups = inventory.log_groups(self.account, self.name)
        things += [Thing("log group", group) for group in groups if group not in own]
        if self._code.exists():
            things.append(Thing("S3 bucket", self._code.name))
        attached = [
            one
            for arn in _physical(resources, "AWS::IAM::ManagedPolicy")
            if (one := policies.attached(self.account, arn))
        ]
        known = inventory.stacks(self.account, self.name)
        installation = _installation(self.account, found)
        return Survey(found, things, self._data(), installation, inventory.addresses(known), attached)

    def run(self, survey: Survey, data: bool) -> None:
        """Take it all away; the data only with `data`. Raises `Problem` when something is in the way."""
        if survey.found:
            self._stack.must_not_be_protected(survey.found)
            for arn in _physical(self._stack.resources(), "AWS::IAM::ManagedPolicy"):
                policies.must_bind_nobody(self.account, arn)
            if survey.found["StackStatus"] != "CREATE_IN_PROGRESS":  # which may be deleted, and may last for hours
                self._stack.attach()
        for bucket in survey.data:
            inventory.mark(self.account, bucket, self.name)
        self._remember(survey)
        self.delete_stack(survey)
        if survey.found:
            screen.done(f"The stack {self.name} is deleted.")
        for addresses in survey.addresses:
            self._acme_records(addresses)
        self._validation_records()
        self._task_definitions()
        for group in inventory.log_groups(self.account, self.name):
            self._gone(self.account.client("logs").delete_log_group, logGroupName=group)
        self._bucket(self._code.name, "code")
        if data:
            for bucket in self._data():
                self._bucket(bucket, "data")

    def _data(self) -> list[str]:
        known = inventory.resources(self.account, self.name)
        return inventory.data_buckets(self.account, self.name, self._code.name, known)

    # -- steps --------------------------------------------------------------------------------------------------------

    def _remember(self, survey: Survey) -> None:
        """Write down which records the site's certificate has left in DNS, while it still says so."""
        if not survey.found or not survey.addresses:
            return
        zone = _zone(survey)
        arns = _physical(self._stack.resources(), "AWS::CertificateManager::Certificate")
        self._records = [one for arn in arns for one in validation.of_certificate(self.account, arn, zone)]
        validation.remember(self._code, self._records)

    def delete_stack(self, survey: Survey, title: str = "Deleting the stack") -> None:
        """Delete it, and see to what is in the way for a while. Raises `Problem` if something else is."""
        gone: list[str] = []
        for last in [False] * (ROUNDS - 1) + [True]:
            if survey.installation:
                self._stop_servers(survey.installation)
            if survey.found:
                self._free_policies()
            try:
                return self._stack.delete(title, gone)
            except NotDeleted as problem:
                needed = waits(problem.failures)
                if last or not needed:
                    raise
                gone = [one.logical_id for one in problem.failures if wait_for(one) is Wait.GONE]
                for wait in needed:
                    screen.say(f"This has to wait until {wait.value}; then the rest is deleted.")
                    self._wait(wait, problem.failures)

    def _wait(self, wait: Wait, failures: Sequence[Failure]) -> None:
        match wait:
            case Wait.CERTIFICATE:
                for failure in failures:
                    if failure.type == "AWS::CertificateManager::Certificate":
                        self._certificate_free(failure.physical_id)
            case Wait.NETWORK:
                self._network_free()
            case Wait.ROLE:
                for failure in failures:
                    if failure.type == "AWS::IAM::Role":
                        policies.free_role(self.account, failure.physical_id)
            case Wait.PAUSE:
                self.sleep(PAUSE)
            case Wait.SERVERS | Wait.POLICY | Wait.GONE:
                pass  # done before, or in, each try

    def _certificate_free(self, arn: str) -> None:
        """Wait until ACM says that nothing uses the certificate. Raises `Problem` after `IN_USE` seconds."""

        def users() -> list[str]:
            found = validation.in_use_by(self.account, arn)
            if ours := [one for one in found if _is_in(self.account, one)]:
                raise Problem(
                    f"The site's certificate is used by {', '.join(ours)}.",
                    "Take the certificate away from there, and run the same command again.",
                )
            return found

        if not users():  # ACM's list and its refusals need not agree at once
            return self.sleep(DISAGREEING)
        self._until_none(
            users,
            "The site's certificate is in use until AWS has dismantled the site's address: 10 to 60 minutes",
            IN_USE,
            lambda left: Problem(
                f"After {duration(IN_USE)} ACM still says that the site's certificate is in use by {', '.join(left)}.",
                "Run the same command later; it goes on from here. If that lasts for a day, only AWS's support can "
                "release it. It costs nothing.",
            ),
        )
        return None

    def _network_free(self) -> None:
        """Wait until no network interface is left in what is ours. Raises `Problem` after `ADDRESSES` seconds."""
        resources = self._stack.resources()
        vpcs = _physical(resources, "AWS::EC2::VPC")
        groups = _physical(resources, "AWS::EC2::SecurityGroup")
        where = {"Name": "vpc-id", "Values": vpcs} if vpcs else {"Name": "group-id", "Values": groups}
        if not where["Values"]:
            return self.sleep(PAUSE)
        client = self.account.client("ec2")

        def interfaces() -> list[str]:
            pages = client.get_paginator("describe_network_interfaces").paginate(Filters=[where])
            found = [one for page in pages for one in page["NetworkInterfaces"]]
            for one in found:
                if instance := one.get("Attachment", {}).get("InstanceId"):
                    raise Problem(
                        f"The instance {instance} is in the network of the installation.",
                        "It is not Hippodrome's: remove it, and run the same command again.",
                    )
            return [str(one["NetworkInterfaceId"]) for one in found]

        if not interfaces():
            return self.sleep(PAUSE)
        self._until_none(
            interfaces,
            "The addresses of servers that have ended are in use for up to 20 minutes",
            ADDRESSES,
            lambda left: Problem(
                f"After {duration(ADDRESSES)} the network still has the interfaces {', '.join(left)}.",
                "See in the EC2 console what they belong to, remove that, and run the same command again.",
            ),
        )
        return None

    def _until_none(
        self,
        look: Callable[[], Sequence[str]],
        title: str,
        longest: int,
        problem: Callable[[Sequence[str]], Problem],
    ) -> None:
        """Look until there is nothing any more; what is raised after `longest` seconds is `problem` of what is left."""
        with screen.progress() as bar:
            bar.add_task(f"{title}; it is safe to interrupt this", total=None)
            waited = 0
            while left := look():
                if waited >= longest:
                    raise problem(left)
                self.sleep(PAUSE)
                waited += PAUSE

    def _free_policies(self) -> None:
        """Detach the stack's managed policies, and say from whom."""
        for arn in _physical(self._stack.resources(), "AWS::IAM::ManagedPolicy"):
            if freed := policies.detach(self.account, arn):
                screen.done(f"The policy {freed.name} is detached from {freed.whom}.")

    def _validation_records(self) -> None:
        """Delete the records that proved the site's name to ACM, unless another certificate needs them."""
        for one in dict.fromkeys([*self._records, *validation.remembered(self._code)]):
            if validation.present(self.account, one) is None:
                continue
            if users := validation.users(self.account, one):
                self.kept.append((one, ", ".join(users)))
            elif validation.remove(self.account, one):
                screen.done(f"The DNS record {one.name} is deleted, which proved the site's name to AWS.")

    def _stop_servers(self, installation: Installation) -> None:
        """By their records while those can be read; then whatever runs in the cluster."""
        ecs = self.account.client("ecs")
        cluster = installation["Cluster"]
        if not inventory.cluster_exists(self.account, cluster):
            return
        if inventory.bucket_exists(self.account, installation["Bucket"]):
            stopper = Stopper(
                self.account.platform(installation), None, partial(leaving, ecs, cluster), sleep=self.sleep
            )
            with screen.progress() as bar:
                task = bar.add_task("Stopping servers", total=None)
                left = stopper.run(STOPPING, lambda stopped: bar.advance(task, stopped))
            if stopper.stopped:
                screen.done(f"{count(len(stopper.stopped), 'server')} stopped.")
            if left.to_do:
                self.errors.extend(stopper.errors)
        waited = 0
        while running := _tasks(ecs, cluster):
            for arn in running:
                self._gone(ecs.stop_task, cluster=cluster, task=arn, reason="the installation is being removed")
            if waited >= STOPPING:
                raise Problem(
                    f"{count(len(running), 'task')} still in the cluster {cluster}.", "Run it again in a minute."
                )
            self.sleep(3)
            waited += 3

    def _acme_records(self, addresses: Addresses) -> None:
        """Proofs of interrupted orders of certificates, if any were left in the zone: of this version or an earlier."""
        for domain in dict.fromkeys((addresses.servers, addresses.root)):
            for name in names_of(domain):
                self._acme_record(f"_acme-challenge.{name.removeprefix('*.')}", addresses.zone)

    def _acme_record(self, name: str, zone: str) -> None:
        client = self.account.client("route53")
        try:
            answer = client.list_resource_record_sets(HostedZoneId=zone, StartRecordName=f"{name}.", MaxItems="10")
        except client.exceptions.NoSuchHostedZone:
            return
        for record in answer["ResourceRecordSets"]:
            mine = record["Name"].rstrip(".") == name and record["Type"] == "TXT" and record.get("TTL") == TTL
            if mine:
                batch = {"Changes": [{"Action": "DELETE", "ResourceRecordSet": record}]}
                self._gone(client.change_resource_record_sets, HostedZoneId=zone, ChangeBatch=batch)

    def _task_definitions(self) -> None:
        ecs = self.account.client("ecs")
        arns = inventory.task_definitions(self.account, self.name)
        if not arns:
            return
        with screen.progress() as bar:
            task = bar.add_task("Removing task definitions", total=len(arns))
            for start in range(0, len(arns), 10):  # DeleteTaskDefinitions takes ten
                chunk = arns[start : start + 10]
                for arn in chunk:
                    self._gone(ecs.deregister_task_definition, taskDefinition=arn)
                self._gone(ecs.delete_task_definitions, taskDefinitions=chunk)
                bar.advance(task, len(chunk))

    def _bucket(self, name: str, what: str) -> None:
        """Delete a bucket of ours with everything in it, old versions too."""
        s3 = self.account.client("s3")
        owner = {"Bucket": name, "ExpectedBucketOwner": self.account.id}
        if not inventory.bucket_exists(self.account, name):
            return
        with screen.progress() as bar:
            task = bar.add_task(f"Emptying the {what} bucket", total=None)
            # Always from the beginning: what is listed after something was deleted has no gaps then.
            while keys := _versions(s3.list_object_versions(**owner)):
                answer = s3.delete_objects(**owner, Delete={"Objects": keys, "Quiet": True})
                if refused := answer.get("Errors"):
                    raise Problem(f"Not everything in {name} could be deleted: {refused[0].get('Message', '')}")
                bar.advance(task, len(keys))
        try:
            s3.delete_bucket(**owner)
        except ClientError as error:
            if errors.code(error) == "BucketNotEmpty":
                raise Problem(f"Somebody is still writing into {name}.", "Run the same command again.") from None
            if errors.code(error) != "NoSuchBucket":
                raise
        screen.done(f"The {what} bucket {name} is deleted.")

    def _gone(self, call: Callable[..., Any], **arguments: Any) -> None:
        """Call; what is gone already is fine."""
        try:
            call(**arguments)
        except ClientError as error:
            if not _GONE.search(f"{errors.code(error)} {errors.message(error)}"):
                raise


def _physical(resources: Iterable[Mapping[str, Any]], kind: str) -> list[str]:
    """The ids of a stack's resources of a type that exist."""
    gone = {"DELETE_COMPLETE", "DELETE_SKIPPED"}
    return [
        str(one["PhysicalResourceId"])
        for one in resources
        if one["ResourceType"] == kind and one.get("PhysicalResourceId") and one.get("ResourceStatus") not in gone
    ]


def _is_in(account: Account, arn: str) -> bool:
    """Whether it is something of this account that uses a certificate: API Gateway's part in it goes by itself."""
    _, _, service, _, owner, *_ = arn.split(":")
    return owner == account.id and service != "apigateway"


def _zone(survey: Survey) -> str:
    """The hosted zone of the stack that is there."""
    standing = inventory.addresses([survey.found] if survey.found else [])
    return (standing or survey.addresses)[0].zone


def _versions(answer: Mapping[str, Any]) -> list[dict[str, str]]:
    found = [*answer.get("Versions", ()), *answer.get("DeleteMarkers", ())]
    return [{"Key": one["Key"], "VersionId": one["VersionId"]} for one in found]


def _tasks(ecs: Any, cluster: str) -> list[str]:
    try:
        return [arn for page in ecs.get_paginator("list_tasks").paginate(cluster=cluster) for arn in page["taskArns"]]
    except ClientError as error:
        if errors.code(error) == "ClusterNotFoundException":
            return []
        raise


def _installation(account: Account, found: Mapping[str, Any] | None) -> Installation | None:
    """The outputs of a stack, whatever its state; None if they are not all there (it never came to life)."""
    installation = Installation.of(account, found) if found else None
    whole = installation and {"Cluster", "Bucket", "HostedZoneId", "RootDomain"} <= set(installation.outputs)
    return installation if whole else None


# -- the command ------------------------------------------------------------------------------------------------------


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
    account.id  # noqa: B018 - whose credentials these are: the first thing that can be wrong
    destroyer = Destroyer(account, stack)
    screen.say(f"Looking for what there is of {stack} in {account.region} …", "dim")
    survey = destroyer.survey()
    if dry_run or not survey:
        return _tell(account, stack, survey, data, as_json)
    _show(survey, data)
    remembered = inventory.resources(account, stack)
    if survey.found or survey.things or data:
        _ask(stack, data and bool(survey.data), yes)
        destroyer.run(survey, data)
    return _prove(destroyer, remembered, options.same_place(account.region, profile), as_json)


def _tell(account: Account, stack: str, survey: Survey, data: bool, as_json: bool) -> int:
    if as_json:
        screen.answer_json(_as_json(survey))
    elif survey:
        _show(survey, data)
    else:
        screen.answer(f"There is nothing of {stack} in {account.region}.")
        if hint := elsewhere(account, stack):
            screen.warn(hint)
    to_do = survey.found or survey.things or (data and survey.data)
    return Exit.CHANGES if to_do else Exit.DONE


def _show(survey: Survey, data: bool) -> None:
    if survey.found:
        screen.say(f"  - the stack, {survey.found['StackStatus']}, with all that it made", "red")
    for kind in dict.fromkeys(thing.kind for thing in survey.things):
        names = [thing.name for thing in survey.things if thing.kind == kind]
        screen.say(f"  - {kind}: {names[0] if len(names) == 1 else len(names)}", "red")
    for attached in survey.attached:
        screen.say(f"  - the policy {attached.name}, which is taken from {attached.whom}", "red")
    for bucket in survey.data:
        if data:
            screen.say(f"  - the participants' data: the bucket {bucket}, every version", "bold red")
        else:
            screen.say(f"  = the participants' data stay: the bucket {bucket}")
    if data and survey.data:
        screen.say(
            "  The servers' certificate goes with the data. Let's Encrypt issues five for a domain in a week; without "
            "--data the next installation takes it over."
        )


def _as_json(survey: Survey) -> dict[str, Any]:
    return {
        "stack": survey.found["StackStatus"] if survey.found else None,
        "things": [{"kind": thing.kind, "name": thing.name} for thing in survey.things],
        "data": list(survey.data),
    }


def _ask(stack: str, data: bool, yes: bool) -> None:
    if yes:
        return
    what = "everything, the participants' data included" if data else "all of this"
    if not sys.stdin.isatty():
        advice = "Add --yes (with make: ARGS=--yes) to go on without."
        raise Problem(f"This needs somebody who types {stack}.", advice, exit_code=Exit.DECLINED)
    screen.err.print(Text(f"To remove {what}, type the stack's name: "), end="")
    if screen.typed() != stack:
        raise Problem("Nothing was removed.", exit_code=Exit.DECLINED)


def _prove(destroyer: Destroyer, remembered: Sequence[inventory.Resource], place: str, as_json: bool) -> int:
    """List what is left, and say so. Raises `Problem` if something is left that should be gone.

    `place` are the options with which other commands find this account and region.
    """
    account = destroyer.account
    after, left = _look_again(destroyer, remembered)
    stays = _records_that_stay(destroyer, after)
    stored = {bucket: inventory.stored(account, bucket) for bucket in after.data}
    roles = inventory.service_roles(account)
    names = [] if after.found else [one for where in after.addresses for one in inventory.server_names(account, where)]
    if as_json:
        screen.answer_json(
            {
                "left": [_left_json(account, thing) for thing in left],
                "kept": list(after.data),
                "storedBytes": stored,
                "records": [{"name": one.name, "why": why, "remove": remove} for one, why, remove in stays],
                "roles": roles,
                "serverNames": names,
                "errors": destroyer.errors,
            }
        )
    else:
        rows = [*_rows(left)]
        rows += [("participants' data", "kept", _month(stored[bucket]), bucket) for bucket in after.data]
        rows += [("DNS record", "kept", "nothing", one.name) for one, _, _ in stays]
        rows += [("server's name", "kept", "nothing", name) for name in names[:10]]
        rows += [("AWS's own role", "kept", "nothing", role) for role in roles]
        _show_table(rows, {inventory.KINDS.get(one.type, "") for one in remembered} - {"", *(one.kind for one in left)})
    for one, why, remove in stays:
        screen.warn(f"The DNS record {one.name} stays: {why}. To delete it:")
        screen.say(f"  {remove}")
    if left:
        details: list[str] = []
        for thing in left:
            details += [f"{thing.kind}: {thing.name} (a month: {inventory.cost_of(thing.kind)})"]
            details += [f"  {removal}"] if (removal := inventory.removal_of(thing, account)) else []
        raise Problem(
            f"{count(len(left), 'thing')} {'is' if len(left) == 1 else 'are'} left.",
            "Run the same command again; what it leaves then, the commands above remove.",
            [*details, *destroyer.errors],
        )
    if names:
        screen.warn(
            f"{count(len(names), 'name')} of servers are in the zone: another installation's with the same domain, or "
            "left over. If there is no other, delete them in Route 53: their addresses may be somebody else's by now."
        )
    for role in roles:
        screen.say(f"The role {role} is the whole account's. If nothing else in it needs that:")
        screen.say(f"  aws iam delete-service-linked-role --role-name {role}")
    what = " else" if after.data or stays or names or roles else ""
    screen.done(f"Nothing{what} is left of {destroyer.name} in {account.region}.")
    for bucket in after.data:
        _tell_kept(account, bucket, place)
    if after.data:
        screen.say("To delete what stays:")
        screen.say(f"  python -m deploy destroy --stack {destroyer.name} --data {place}")
    return Exit.DONE


def _look_again(destroyer: Destroyer, remembered: Sequence[inventory.Resource]) -> tuple[Survey, list[Thing]]:
    """What there is now, and what of it should be gone. What AWS goes on listing for a while is waited for."""
    waited = 0
    with screen.progress() as bar:
        while True:
            after = destroyer.survey()
            found = inventory.still_there(destroyer.account, remembered)
            found += [*after.things, *inventory.tagged(destroyer.account, destroyer.name)]
            left = [thing for thing in dict.fromkeys(found) if thing.name not in after.data]
            if not left or waited >= LISTED:
                return after, left
            if not waited:
                bar.add_task(f"AWS still lists {count(len(left), 'thing')}: up to {duration(LISTED)}", total=None)
            destroyer.sleep(PAUSE)
            waited += PAUSE


def _records_that_stay(destroyer: Destroyer, after: Survey) -> list[tuple[Validation, str, str]]:
    """Validation records that are not deleted: each with the reason, and the command that deletes it."""
    account = destroyer.account
    found = [(one, f"it renews {users} as well") for one, users in destroyer.kept]
    known = {one for one, _ in found}
    for addresses in after.addresses if not after.found else ():
        for one in validation.alike(account, addresses.zone, addresses.site):
            if one not in known:
                users = validation.users(account, one)
                why = f"it renews {', '.join(users)}" if users else "it may prove the name for another AWS account"
                found.append((one, why))
    return [
        (one, why, validation.removal(one.zone, record))
        for one, why in found
        if (record := validation.present(account, one))
    ]


def _left_json(account: Account, thing: Thing) -> dict[str, str]:
    more = {"month": inventory.cost_of(thing.kind), "remove": inventory.removal_of(thing, account)}
    return {"kind": thing.kind, "name": thing.name} | more


def _month(stored: int) -> str:
    """What so many bytes cost in S3."""
    return f"${stored / 1e9 * Prices().s3_gb_month.usd:,.2f} ({size(stored)})"


def _tell_kept(account: Account, bucket: str, place: str) -> None:
    """How to get at the data, now that no stack leads to them."""
    projects = kept_bucket.projects(account, bucket)
    if not projects:
        found = (
            "The participants' data in it have been deleted; S3 keeps their older versions for about "
            f"{OLD_VERSIONS} days."
            if kept_bucket.older_versions(account, bucket)
            else "There are no participants' data in it."
        )
        screen.say(f"The bucket {bucket} stays. {found}")
        return
    screen.say(f"The participants' data stay in the bucket {bucket}. To fetch them:")
    for project in projects:
        screen.say(f"  python -m deploy data --project {project} --bucket {bucket} {place}")


def _rows(left: Sequence[Thing]) -> Iterator[tuple[str, str, str, str]]:
    for kind in sorted({one.kind for one in left}):
        names = [one.name for one in left if one.kind == kind]
        yield kind, str(len(names)), inventory.cost_of(kind), ", ".join(names[:3])


def _show_table(rows: Sequence[Sequence[str]], without: set[str]) -> None:
    """What is left or kept, a row each; the kinds of which nothing is left are only counted."""
    if rows:
        screen.table(["what", "left", "a month", ""], rows)
    if without:
        kinds = count(len(without), "other kind" if rows else "kind")
        screen.answer(f"{kinds} of things looked at: nothing left.")
