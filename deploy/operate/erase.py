"""`deploy erase`: everything about one person gone, and a receipt that names nobody.

Who has played on a warm server is also named by what told that server so, and by that server's own record, which has
the label of whom it was given to. The person's record leads to both, so it is deleted last.

The server goes first, and only when its task has ended (a trial saves what it has when it is told to stop) the
documents: every version, every delete marker, every unfinished upload. A server's presigned requests
(`hippodrome/servers/signing.py`) outlive it for a moment, so this waits for that moment. A last listing proves that
nothing remains; what somebody has brought meanwhile, such as the participant coming back, is erased in another round.

Facts (S3 API Reference, read November 2026): a versioned bucket keeps what is deleted until each version is deleted by
its id; in a bucket without versions the id is "null". DeleteObjects takes 1,000, answers 200, and says in `Errors` what
it has not deleted.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import secrets
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import Progress, TaskID

from console import screen
from console.problem import Exit, Problem
from deploy.aws.account import STACK, Account, Installation, find_installation, open_account
from deploy.core import options, participants
from deploy.core.quiet import functions_log
from deploy.core.server_records import runs
from deploy.operate.stop import leaving
from hippodrome.model import ids, messages, server
from hippodrome.model.messages import StopServer
from hippodrome.model.records import from_json
from hippodrome.model.server import Reason, Server
from hippodrome.ports import DnsRecord, Platform, RunningTask
from protocol.keys import handover_key, participant_folder

if TYPE_CHECKING:
    from hippodrome.limits.slots import Slots

ROUNDS = 6  # of erasing and looking again
WAIT = 240  # seconds until a task must have ended: its stopTimeout is 120, and AWS takes a while
PAUSE = 3  # seconds between two looks at it
SETTLED = timedelta(seconds=60)  # after this, ECS's lists know of every task that a start has run
SIGNING = 30  # seconds that `sign_requests` may take from its look at a server's record to the signature
BATCH = 1_000  # versions deleted at once

NOT_COVERED = (
    "Copies that somebody has downloaded: `python -m deploy data` into the same folder removes this person there too.",
    "Messages about their server that are still in a queue; SQS deletes them, dead letters after 14 days at most.",
    "Older versions of the lists of who holds a place where places are limited: hashes, soon deleted by the bucket.",
    "AWS's own records: ECS shows a stopped task for about an hour, CloudTrail may keep the call that ran it 90 days.",
    "What the recruiter knows of them.",
)


@dataclass
class Version:
    """One version or delete marker of a document, or an unfinished upload (`upload` is its id)."""

    key: str
    id: str
    size: int = 0
    marker: bool = False
    upload: str = ""


@dataclass
class Found:
    """What one look found of a person in one project."""

    documents: int = 0  # versions, delete markers and unfinished uploads
    record: Server | None = None
    tasks: list[RunningTask] = field(default_factory=list)
    leaving: list[str] = field(default_factory=list)  # names of tasks that were told to stop and have not ended
    timers: list[str] = field(default_factory=list)
    names: list[DnsRecord] = field(default_factory=list)
    clusters: list[str] = field(default_factory=list)
    places: int = 0  # of those that `maxParticipants` counts

    def __bool__(self) -> bool:
        return any(self.counts().values())

    @property
    def runs(self) -> bool:
        """Whether there is more than documents."""
        closed = self.record is None or self.record.is_closed
        return bool(self.tasks or self.leaving or self.timers or self.names or self.clusters or not closed)

    def counts(self) -> dict[str, int]:
        return {
            "documents": self.documents,
            "tasks": len(self.tasks) + len(self.leaving),
            "timers": len(self.timers),
            "names": len(self.names),
            "clusters": len(self.clusters),
            "places": self.places,
        }


class Eraser:
    """Erases one person from one project. May be cut off anywhere and begun again.

    `late=False` does not wait for what their server may still store just afterwards: enough for bots.
    `clock` and `sleep` are for tests.
    """

    def __init__(
        self,
        account: Account,
        installation: Installation,
        project: str,
        user: str,
        *,
        late: bool = True,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.project = project
        self._user = user
        self._account = account
        self._bucket = {"Bucket": installation["Bucket"], "ExpectedBucketOwner": account.id}
        self._installation = installation
        self._platform: Platform = account.platform(installation)
        self._late = late
        self._clock = clock
        self._sleep = sleep
        self._label = ids.server_label(project, user)
        self._folder = participant_folder(project, user)
        self._record_key = server.key(self._label)
        self._warm_servers: frozenset[str] = frozenset()  # names of warm servers that they were given
        self.deleted: dict[str, dict[str, int]] = {}
        self.keys: dict[str, int] = {}
        self.let_go = {"tasks": 0, "timers": 0, "names": 0, "clusters": 0}
        self.rounds = 0
        self.remains: Mapping[str, int] | None = None
        self.looked: datetime | None = None

    # -- looking

    def look(self) -> Found:
        """Everything there is of this person, counted; nothing is changed."""
        platform = self._platform
        record = self._record()
        self._warm_servers = self._warm_servers.union(warm_servers_of(record))
        tasks, going, clusters = self._tasks()
        names = {name for name in platform.dns.list() if self._ours(name.name.partition(".")[0])}
        if record and record.dns_record and self._resolves(record.dns_record):
            names.add(record.dns_record)
        found = Found(
            documents=sum(1 for _ in self._versions()),
            record=record,
            tasks=tasks,
            leaving=going,
            timers=[name for name in self._timers() if self._ours(name.removesuffix("-delay"))],
            names=sorted(names),
            clusters=clusters,
            places=len(self._slots().holds(self.project, self._user)),
        )
        self.remains, self.looked = found.counts(), platform.now()
        return found

    def unreadable(self) -> list[str]:
        """Documents of which nobody can say whether they name this person."""
        return self._slots().unreadable(self.project)

    def _slots(self) -> Slots:
        from hippodrome.limits.slots import Slots  # noqa: PLC0415 - imports Powertools, which other commands do without

        return Slots(self._platform)

    def _tasks(self) -> tuple[list[RunningTask], list[str], list[str]]:
        """Tasks of theirs that live, the names of those that are ending, and their own clusters."""
        tasks = [task for task in self._platform.tasks.list() if self._ours(task.name)]
        clusters = [name for name in self._platform.tasks.clusters() if self._ours(name)]
        ecs = self._account.client("ecs")
        going = [name for where in (self._installation["Cluster"], *clusters) for name in leaving(ecs, where)]
        return tasks, [name for name in going if self._ours(name)], clusters

    def _ours(self, name: str) -> bool:
        parsed = ids.parse_server_name(name)
        return name in self._warm_servers or (parsed is not None and parsed[0] == self._label)

    def _record(self) -> Server | None:
        document = self._platform.documents.get(self._record_key)
        try:
            return from_json(document.body, Server) if document else None
        except (ValueError, RecursionError):  # it will be deleted as any document
            return None

    def _timers(self) -> Iterator[str]:
        pages = self._account.client("scheduler").get_paginator("list_schedules")
        for prefix in (f"{self._label}-", *sorted(self._warm_servers)):
            for page in pages.paginate(GroupName=self._installation["ScheduleGroup"], NamePrefix=prefix):
                yield from (line["Name"] for line in page["Schedules"])

    def _resolves(self, record: DnsRecord) -> bool:
        """Whether the zone has that very record; `subdomain: userId` gives names that no listing of ours shows."""
        answer = self._account.client("route53").list_resource_record_sets(
            HostedZoneId=self._installation["HostedZoneId"],
            StartRecordName=record.name,
            StartRecordType="A",
            MaxItems="1",
        )
        return any(
            found["Type"] == "A"
            and found["Name"].rstrip(".").lower() == record.name.lower()
            and [value["Value"] for value in found.get("ResourceRecords", ())] == [record.host]
            for found in answer["ResourceRecordSets"]
        )

    def _versions(self) -> Iterator[Version]:
        """Every version of every document of theirs. The prefix ends with a slash: `ann` is not `anna`."""
        return itertools.chain.from_iterable(self._parts())

    def _parts(self) -> tuple[Iterator[Version], ...]:
        """The same in the order in which they have to go: the record is what leads to those of warm servers."""
        of_warm_servers = itertools.chain.from_iterable(map(self._versions_of, self._warm_server_keys()))
        return self._versions_below(self._folder), self._uploads(), of_warm_servers, self._versions_of(self._record_key)

    def _warm_server_keys(self) -> list[str]:
        """What says of warm servers that this person had them."""
        labels = [parsed[0] for name in self._warm_servers if (parsed := ids.parse_server_name(name))]
        told = [handover_key(self.project, name) for name in self._warm_servers]
        return sorted([*told, *(server.key(label) for label in labels)])

    def _versions_of(self, key: str) -> Iterator[Version]:
        return (version for version in self._versions_below(key) if version.key == key)

    def _versions_below(self, prefix: str) -> Iterator[Version]:
        pages = self._account.client("s3").get_paginator("list_object_versions")
        for page in pages.paginate(Prefix=prefix, **self._bucket):
            for line in page.get("Versions", ()):
                yield Version(line["Key"], line["VersionId"], line["Size"])
            for line in page.get("DeleteMarkers", ()):
                yield Version(line["Key"], line["VersionId"], marker=True)

    def _uploads(self) -> Iterator[Version]:
        s3 = self._account.client("s3")
        for page in s3.get_paginator("list_multipart_uploads").paginate(Prefix=self._folder, **self._bucket):
            for line in page.get("Uploads", ()):
                yield Version(line["Key"], "", upload=line["UploadId"])

    # -- erasing

    def run(self, advance: Callable[[int], None] = lambda _: None) -> Found:
        """Erase until a look finds nothing, `ROUNDS` times at most; what the last look found. Raises `Problem`."""
        found = self.look()
        while found and self.rounds < ROUNDS:
            self.rounds += 1
            if found.runs:
                self._stop(found)
            if not found.tasks and self._settling(found.record):
                end = self._clock() + SETTLED.total_seconds()
                while self._clock() < end and not self._tasks()[0]:
                    self._sleep(PAUSE)
                self._wait()
            self._delete(advance)
            if found.places:  # last: until then nobody else takes it
                self._slots().forget(self.project, self._user)
            if self._late and found.record:
                self._outlast(found.record)
            found = self.look()
        return found

    def _stop(self, found: Found) -> None:
        """Let the server go as `stop_server` does, and wait until its task has ended."""
        from hippodrome.servers.service import Servers  # noqa: PLC0415 - imports Powertools, which other commands do without

        platform = self._platform
        self.let_go["tasks"] += len(found.tasks)
        self.let_go["timers"] += len(found.timers)
        self.let_go["names"] += len(found.names)
        self.let_go["clusters"] += len(found.clusters)
        if found.record and not found.record.is_closed:
            with functions_log():  # what fails here is done again below
                Servers(platform).stop([StopServer(self.project, self._user, None, Reason.STOPPED)])
        for task in found.tasks:
            platform.tasks.stop(task.task, task.cluster, f"{messages.OUR_STOP} {Reason.STOPPED}")
        for timer in found.timers:
            platform.timers.cancel(timer)
        if found.names:
            platform.dns.change(remove=found.names)
        self._wait()
        for cluster in found.clusters:
            platform.tasks.delete_cluster(cluster)

    def _wait(self) -> None:
        """Until no task is left that could write something. Raises `Problem`."""
        end = self._clock() + WAIT
        while True:
            tasks, going, _ = self._tasks()
            for task in tasks:
                self._platform.tasks.stop(task.task, task.cluster, f"{messages.OUR_STOP} {Reason.STOPPED}")
            if not tasks and not going:
                return
            if self._clock() >= end:
                raise Problem(
                    "Their server has been told to stop and still runs; their documents were not touched.",
                    "Wait a few minutes and run the same command again: it goes on from there.",
                )
            self._sleep(PAUSE)

    def _outlast(self, record: Server) -> None:
        """Until no presigned request is good that their server may have. The record is gone: it gets no more."""
        from hippodrome.servers.signing import SECONDS, STORING  # noqa: PLC0415 - as above

        signed = STORING.total_seconds()  # from its end until it was given the last
        if record.closed is not None:
            signed -= (self._platform.now() - record.closed).total_seconds()
        left = SECONDS + SIGNING + min(signed, 0)
        if left > 0:
            screen.say(f"{left:.0f} seconds more: until then what their server was given might store something.")
            self._sleep(left)

    def _settling(self, record: Server | None) -> bool:
        """Whether a task may have been run a moment ago that ECS does not list yet."""
        young = record is not None and self._platform.now() - record.requested < SETTLED
        return young and record is not None and record.task is None and bool(record.cluster)

    def _delete(self, advance: Callable[[int], None]) -> None:
        for versions in self._parts():
            self._delete_all(versions, advance)

    def _delete_all(self, versions: Iterable[Version], advance: Callable[[int], None]) -> None:
        batch: list[Version] = []
        for version in versions:
            if version.upload:
                self._account.client("s3").abort_multipart_upload(
                    Key=version.key, UploadId=version.upload, **self._bucket
                )
                self._note(version)
                advance(1)
                continue
            batch.append(version)
            if len(batch) == BATCH:
                self._delete_batch(batch)
                advance(len(batch))
                batch = []
        if batch:
            self._delete_batch(batch)
            advance(len(batch))

    def _delete_batch(self, batch: list[Version]) -> None:
        objects = [{"Key": version.key, "VersionId": version.id} for version in batch]
        answer = self._account.client("s3").delete_objects(Delete={"Objects": objects, "Quiet": True}, **self._bucket)
        failed = {(line.get("Key"), line.get("VersionId")): line for line in answer.get("Errors", ())}
        for version in batch:
            if (version.key, version.id) not in failed:
                self._note(version)
        if failed:
            codes = sorted({str(line.get("Code")) for line in failed.values()})
            raise Problem(
                f"{len(failed):,} versions could not be deleted: {', '.join(codes)}.",
                "These credentials need s3:DeleteObjectVersion, and nothing may be under an object lock.",
            )

    def _note(self, version: Version) -> None:
        kind = self._kind(version.key)
        counts = self.deleted.setdefault(kind, {"versions": 0, "deleteMarkers": 0, "uploads": 0, "bytes": 0})
        counts["uploads" if version.upload else "deleteMarkers" if version.marker else "versions"] += 1
        counts["bytes"] += version.size
        shown = self._nameless(version.key)
        self.keys[shown] = self.keys.get(shown, 0) + 1

    def _kind(self, key: str) -> str:
        rest = key.removeprefix(self._folder)
        if rest == key:
            return "server record"
        if rest == "participant.json":
            return "participant"
        kinds = {"answers": "answers", "trials": "recordings"}
        return kinds.get(rest.partition("/")[0], "other")

    def _nameless(self, key: str) -> str:
        """The key without the id and without the server's label, which can be computed from it."""
        rest = key.removeprefix(self._folder)
        if rest == key:
            return f"{key.rpartition('/')[0]}/{{server}}.json"
        rest = "/".join(
            "{userId}" if self._user in part else part for part in rest.replace(self._label, "{server}").split("/")
        )
        return f"{self.project}/users/{{userId}}/{rest}"

    # -- telling

    def report(self) -> dict[str, Any]:
        """This project's part of the receipt."""
        return {
            "project": self.project,
            "deleted": self.deleted,
            "letGo": self.let_go,
            "keys": self.keys,
            "rounds": self.rounds,
            "remains": self.remains,
            "listed": _time(self.looked),
        }


def warm_servers_of(record: Server | None) -> list[str]:
    """The names of the warm servers that a participant has been given, in all attempts."""
    return [run.warm_server for run in runs(record) if run.warm_server] if record else []


def command(
    user: Annotated[str, typer.Argument(help="The participant's id (userId), exactly as in their link.")],
    *,
    project: options.ProjectId = None,
    everywhere: Annotated[
        bool, typer.Option("--everywhere", help="In every project of the installation, not in one.")
    ] = False,
    receipt: Annotated[
        Path | None,
        typer.Option("--receipt", help="Where to write the receipt; else erased-<time>.json here.", show_default=False),
    ] = None,
    with_id: Annotated[bool, typer.Option("--with-id", help="Write the id itself into the receipt, too.")] = False,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Erase everything about one person: documents in all their versions, recordings, their server and its traces.

    This cannot be undone. The receipt says what was deleted, when and by whom, and that a last listing found nothing;
    it names the person by a salted hash, which whoever has the id can check. Afterwards run `data` again wherever
    somebody has downloaded the study: it removes the person there.
    """
    from deploy.core.study_choice import project_id  # noqa: PLC0415 - only here

    if not ids.is_user_id(user):
        raise Problem("That is no participant's id.", "Ids have letters, digits, dashes and underscores, 64 at most.")
    if everywhere and project is not None:
        raise Problem("--project names one project, --everywhere means all of them.", "Give one of the two.")
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    where = _projects(account, installation) if everywhere else [project_id(project)]
    erasers = [Eraser(account, installation, name, user) for name in where]
    found = {eraser.project: eraser.look() for eraser in erasers}
    if not everywhere and not any(found.values()):
        _must_be_known(where[0], _projects(account, installation), stack)
    if not json or dry_run:
        _show(found, json, dry_run)
    if dry_run:
        return Exit.CHANGES if any(found.values()) else Exit.DONE
    if any(found.values()):
        here = [name for name, one in found.items() if one]
        screen.confirm(f"Erase this person for good from {', '.join(here)}?", yes)
    began, whole = datetime.now(UTC), False
    target = receipt or Path(f"erased-{began:%Y%m%dT%H%M%SZ}.json")
    if target.exists() or not target.parent.is_dir():
        raise Problem(f"The receipt cannot be written to {target}.", "Name a new file in a folder that exists.")
    try:
        _erase(erasers, found)
        whole = True
    finally:
        made = _receipt(erasers, user, account, installation, began=began, whole=whole, with_id=with_id)
        if whole or any(eraser.deleted for eraser in erasers):
            _write(target, made)
    if json:
        screen.answer_json(made)
    _warn_of_unreadable(erasers)
    if any(found.values()):
        screen.done(f"Everything is gone. The receipt: {target}")
        screen.say("  Where this study was downloaded, run `python -m deploy data` again: it removes them there.")
    else:
        screen.done(f"There is nothing of this person. The receipt: {target}")
    return Exit.DONE


def _projects(account: Account, installation: Installation) -> list[str]:
    """Every project, also one that is not registered any more but has left documents."""
    names = {project.id for project in participants.registered(account.platform(installation).documents)}
    pages = account.client("s3").get_paginator("list_object_versions")
    for page in pages.paginate(Bucket=installation["Bucket"], Delimiter="/", ExpectedBucketOwner=account.id):
        names.update(line["Prefix"].rstrip("/") for line in page.get("CommonPrefixes", ()))
    return sorted(name for name in names if ids.is_project_id(name))


def _must_be_known(project: str, known: list[str], stack: str) -> None:
    """A slip of the pen must not read as an erasure. Raises `Problem`."""
    if project not in known:
        raise Problem(
            f"The installation {stack} holds nothing of a project {project}.",
            f"Name another with --project, or take --everywhere. It holds: {', '.join(known) or 'no project yet'}.",
        )


def _erase(erasers: list[Eraser], found: Mapping[str, Found]) -> None:
    with screen.progress() as bars:
        bar = bars.add_task("Erasing", total=sum(one.documents for one in found.values()))
        for eraser in erasers:
            left = (
                eraser.run(lambda count: _advance(bars, bar, count)) if found[eraser.project] else found[eraser.project]
            )
            if left:
                raise Problem(
                    f"After {ROUNDS} rounds there is still something in {eraser.project}: {_words(left)}.",
                    "Somebody keeps using their link. Close the study with `register --no-live`, and run this again.",
                )


def _warn_of_unreadable(erasers: list[Eraser]) -> None:
    for key in itertools.chain.from_iterable(eraser.unreadable() for eraser in erasers):
        screen.warn(f"{key} cannot be read, and may hold a hash of the id: `python -m deploy doctor` says what to do.")


def _advance(bars: Progress, bar: TaskID, count: int) -> None:
    """The bar goes on; what comes to light while the server is stopped (its last recording) makes it longer."""
    task = bars.tasks[0]
    bars.update(bar, advance=count, total=max(task.total or 0, task.completed + count))


def _show(found: Mapping[str, Found], json: bool, dry_run: bool) -> None:
    if json:
        screen.answer_json({"found": {name: one.counts() for name, one in found.items()}})
        return
    rows = [(name, *one.counts().values()) for name, one in found.items() if one]
    if rows:
        heads = list(Found().counts())
        screen.table(["project", *heads], rows, right=heads)
    elif dry_run:
        screen.answer(f"There is nothing of this person in {', '.join(found) or 'any project'}.")


def _words(found: Found) -> str:
    return ", ".join(f"{count:,} {what}" for what, count in found.counts().items() if count)


def _receipt(
    erasers: list[Eraser],
    user: str,
    account: Account,
    installation: Installation,
    *,
    began: datetime,
    whole: bool,
    with_id: bool,
) -> dict[str, Any]:
    salt = secrets.token_hex(16)
    person = {
        "salt": salt,
        "sha256": hashlib.sha256(f"{salt}{user}".encode()).hexdigest(),
        "check": "sha256 of the salt followed by the id",
    }
    return {
        "schema": 1,
        "what": "erasure of a participant's data",
        "complete": whole,
        "person": {**person, "userId": user} if with_id else person,
        "stack": installation.stack,
        "region": installation.region,
        "bucket": installation["Bucket"],
        "by": account.identity["Arn"],
        "began": _time(began),
        "ended": _time(datetime.now(UTC)),
        "projects": [eraser.report() for eraser in erasers],
        "notCovered": list(NOT_COVERED),
    }


def _write(target: Path, receipt: Mapping[str, Any]) -> None:
    try:
        with target.open("x", encoding="utf-8") as file:
            json.dump(receipt, file, indent=1)
            file.write("\n")
    except OSError as error:
        raise Problem(
            f"The receipt could not be written: {error.strerror}.",
            "Run the command again: it writes another one, of a listing that finds nothing.",
        ) from None


def _time(moment: datetime | None) -> str | None:
    return None if moment is None else moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
