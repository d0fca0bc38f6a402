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

from deploy import inventory, options, screen
from deploy.account import STACK, Account, Installation, open_account
from deploy.code_bucket import CodeBucket
from deploy.data import kept
from deploy.inventory import Thing
from deploy.problem import Exit, Problem
from deploy.stack import Stack
from deploy.stop import Stopper, leaving
from deploy.words import count
from hippodrome.aws import errors
from hippodrome.aws.challenges import TTL

STOPPING = 180  # seconds that servers may take: a task has 120 to save what it has
ROUNDS = 3  # how often servers are stopped and the deletion tried again: somebody may start one in between

_STILL_RUNNING = re.compile(
    r"contains? ?tasks|ClusterContains|in use|DependencyViolation|dependent object", re.IGNORECASE
)

_GONE = re.compile(r"NotFound|not found|does not exist|NoSuch|inactive")


@dataclass(frozen=True)
class Survey:
    """What there is of an installation."""

    found: Mapping[str, Any] | None  # the stack, if it is still there
    things: Sequence[Thing]  # what the commands made beside it, and what it left
    data: Sequence[str]  # data buckets
    installation: Installation | None  # if its outputs are known

    def __bool__(self) -> bool:
        return bool(self.found or self.things or self.data)


class Destroyer:
    """Takes an installation away, step by step; every step may be repeated, and finds done what is done."""

    def __init__(self, account: Account, name: str, sleep: Callable[[float], None] = time.sleep) -> None:
        self.account = account
        self.name = name
        self._sleep = sleep
        self._stack = Stack(account, name, sleep)
        self._code = CodeBucket(account, name)
        self.errors: list[str] = []

    def survey(self) -> Survey:
        """Look; changes nothing."""
        found = self._stack.describe()
        things = [Thing("ECS task definition", arn) for arn in inventory.task_definitions(self.account, self.name)]
        own = {one.get("PhysicalResourceId") for one in self._stack.resources()} if found else set()
        groups = inventory.log_groups(self.account, self.name)
        things += [Thing("log group", group) for group in groups if group not in own]
        if self._code.exists():
            things.append(Thing("S3 bucket", self._code.name))
        data = self._data()
        return Survey(found, things, data, _installation(self.account, found))

    def run(self, survey: Survey, data: bool) -> None:
        """Take it all away; the data only with `data`. Raises `Problem` when something is in the way."""
        self._stack.attach()
        for bucket in survey.data:
            inventory.mark(self.account, bucket, self.name)
        for last in [False] * (ROUNDS - 1) + [True]:
            if survey.installation:
                self._stop_servers(survey.installation)
            try:
                self._stack.delete()
            except Problem as problem:
                if last or not any(_STILL_RUNNING.search(line) for line in problem.details):
                    raise
                screen.say("Something was still running: once more.")
            else:
                break
        if survey.found:
            screen.done(f"The stack {self.name} is deleted.")
        if survey.installation:
            self._acme_records(survey.installation)
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

    def _stop_servers(self, installation: Installation) -> None:
        """By their records while those can be read; then whatever runs in the cluster."""
        ecs = self.account.client("ecs")
        cluster = installation["Cluster"]
        if not inventory.cluster_exists(self.account, cluster):
            return
        if inventory.bucket_exists(self.account, installation["Bucket"]):
            stopper = Stopper(
                self.account.platform(installation), None, partial(leaving, ecs, cluster), sleep=self._sleep
            )
            with screen.progress() as bar:
                task = bar.add_task("Stopping servers", total=None)
                left = stopper.run(STOPPING, lambda stopped: bar.advance(task, stopped))
            if stopper.stopped:
                screen.done(f"{count(len(stopper.stopped), 'server')} stopped.")
            if left.to_do:
                self.errors.extend(stopper.errors)
        end = time.monotonic() + STOPPING
        while running := _tasks(ecs, cluster):
            for arn in running:
                self._gone(ecs.stop_task, cluster=cluster, task=arn, reason="the installation is being removed")
            if time.monotonic() > end:
                raise Problem(
                    f"{count(len(running), 'task')} still in the cluster {cluster}.", "Run it again in a minute."
                )
            self._sleep(3)

    def _acme_records(self, installation: Installation) -> None:
        """A proof of an interrupted order of a certificate, if one was left in the zone."""
        client = self.account.client("route53")
        name, zone = f"_acme-challenge.{installation['RootDomain']}", installation["HostedZoneId"]
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
    to_do = survey.found or survey.things or (data and survey.data)
    return Exit.CHANGES if to_do else Exit.DONE


def _show(survey: Survey, data: bool) -> None:
    if survey.found:
        screen.say(f"  - the stack, {survey.found['StackStatus']}, with all that it made", "red")
    for kind in dict.fromkeys(thing.kind for thing in survey.things):
        names = [thing.name for thing in survey.things if thing.kind == kind]
        screen.say(f"  - {kind}: {names[0] if len(names) == 1 else len(names)}", "red")
    for bucket in survey.data:
        if data:
            screen.say(f"  - the participants' data: the bucket {bucket}, every version", "bold red")
        else:
            screen.say(f"  = the participants' data stay: the bucket {bucket}")


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
        raise Problem(f"This needs somebody who types {stack}.", "Add --yes to go on without.", exit_code=Exit.DECLINED)
    screen.err.print(Text(f"To remove {what}, type the stack's name: "), end="")
    if screen.typed() != stack:
        raise Problem("Nothing was removed.", exit_code=Exit.DECLINED)


def _prove(destroyer: Destroyer, remembered: Sequence[inventory.Resource], place: str, as_json: bool) -> int:
    """List what is left, and say so. Raises `Problem` if something is left that should be gone.

    `place` are the options with which other commands find this account and region.
    """
    after = destroyer.survey()
    found = inventory.still_there(destroyer.account, remembered)
    found += [*after.things, *inventory.tagged(destroyer.account, destroyer.name)]
    left = [thing for thing in dict.fromkeys(found) if thing.name not in after.data]
    if as_json:
        names = [{"kind": thing.kind, "name": thing.name} for thing in left]
        screen.answer_json({"left": names, "kept": list(after.data), "errors": destroyer.errors})
    else:
        rows = [*_rows(remembered, left), *(("participants' data", "kept", bucket) for bucket in after.data)]
        screen.table(["what", "left", ""], rows)
    if left:
        details = [*(f"{one.kind}: {one.name}" for one in left), *destroyer.errors]
        raise Problem(
            f"{count(len(left), 'thing')} {'is' if len(left) == 1 else 'are'} left.",
            "Run the same command again.",
            details,
        )
    screen.done(f"Nothing{' else' if after.data else ''} is left of {destroyer.name} in {destroyer.account.region}.")
    for bucket in after.data:
        _tell_kept(bucket, kept.projects(destroyer.account, bucket), place)
    if after.data:
        screen.say("To delete what stays:")
        screen.say(f"  python -m deploy destroy --stack {destroyer.name} --data {place}")
    return Exit.DONE


def _tell_kept(bucket: str, projects: Sequence[str], place: str) -> None:
    """How to get at the data, now that no stack leads to them."""
    if not projects:
        screen.say(f"The bucket {bucket} stays; of participants it holds older versions at most.")
        return
    screen.say(f"The participants' data stay in the bucket {bucket}. To fetch them:")
    for project in projects:
        screen.say(f"  python -m deploy data --project {project} --bucket {bucket} {place}")


def _rows(remembered: Iterable[inventory.Resource], left: Sequence[Thing]) -> Iterator[tuple[str, str, str]]:
    kinds: dict[str, int] = {}
    for resource in remembered:
        if kind := inventory.KINDS.get(resource.type):
            kinds[kind] = kinds.get(kind, 0) + 1
    for kind in sorted({*kinds, *(one.kind for one in left)}):
        names = [one.name for one in left if one.kind == kind]
        yield kind, str(len(names)), ", ".join(names[:3])
