"""Takes snapshots of an installation: projects, servers, queues, certificate and alarms, each read by itself.

If a part cannot be read (a missing permission, AWS is busy), it stays empty, and `problems` says why.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, NamedTuple

from hippodrome.console.formatting import count
from hippodrome.console.problem import Problem
from hippodrome.control.certificates.rules import renew_at
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project, UnreadableEntry
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import Documents
from hippodrome.control.servers.causes import Cause, FailureCategory, parse_cause
from hippodrome.control.servers.sessions import readable_session
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.core import explain, participants
from hippodrome.deployment.core.participants import ParticipantCounts
from hippodrome.deployment.core.server_records import SLACK, Records, attempts_of
from hippodrome.deployment.cost.spent import Spent, spent
from hippodrome.deployment.stack.stack import Stack

ASK = "`hippodrome doctor --all` names them"
DAY = timedelta(days=1)  # the age up to which failures are shown
DAILY = timedelta(days=1)  # the interval of the function renew_certificate


@dataclass(frozen=True)
class StackQueue:
    """A queue of the stack. `dead`: it is a dead-letter queue."""

    name: str
    waiting: int
    in_flight: int
    delayed: int
    dead: bool


@dataclass(frozen=True)
class CertificateState:
    """The servers' certificate in the bucket. `renewal`: the time from which the function orders the next one."""

    names: tuple[str, ...]
    renewal: datetime
    expires: datetime
    days_left: int
    staging: bool  # whether it is from an authority for tests, which browsers do not trust

    def overdue(self, now: datetime) -> bool:
        """Whether the next certificate should be there by now."""
        return now > self.renewal + DAILY

    def urgent(self, now: datetime) -> bool:
        """Whether less than a quarter of the time for renewing is left: about a week of 90 days, four days of 45."""
        return self.expires - now < (self.expires - self.renewal) / 4


class WarmServers(NamedTuple):
    """Warm servers of a project: how many are ready, how many exist, and how many were assigned today."""

    ready: int
    there: int
    assigned_today: int


class ServerFailure(NamedTuple):
    """How many servers of a project failed for one cause in the last 24 hours, and the time and name of the last."""

    project: str
    cause: Cause
    servers: int
    last: datetime
    server: str

    @property
    def matters(self) -> bool:
        """Whether the researcher or administrator can prevent such failures."""
        return self.cause.category is not FailureCategory.AWS


@dataclass
class Snapshot:
    """The results of one look at an installation. `problems`: by part, why the part is missing."""

    at: datetime
    projects: list[tuple[Project, ParticipantCounts]] = field(default_factory=list)
    servers: list[Server] = field(default_factory=list)  # open ones
    members: dict[str, int] = field(default_factory=dict)  # server's name → number of its session's members
    recent: list[Server] = field(default_factory=list)  # records written in the last day, or in a server's longest life
    tasks: int | None = None  # the number of tasks that run on ECS
    spent: Spent = field(default_factory=Spent)
    queues: list[StackQueue] = field(default_factory=list)
    certificate: CertificateState | None = None
    alarms: list[str] = field(default_factory=list)
    problems: dict[str, str] = field(default_factory=dict)

    @property
    def closed_today(self) -> Counter[str]:
        """Count the servers that were closed today, by reason. Warm servers that were assigned do not count."""
        return Counter(str(r.reason) for r in self._closed_today() if r.reason is not Reason.ASSIGNED)

    @property
    def failures(self) -> list[ServerFailure]:
        """Return why servers failed in the last 24 hours: preventable causes first, then by number of servers."""
        by_cause: dict[tuple[str, Cause], list[tuple[datetime, str]]] = {}
        for record in self.recent:
            for attempt in attempts_of(record):
                cause = parse_cause(attempt.cause)
                if cause and attempt.closed and attempt.closed >= self.at - DAY:
                    name = attempt.warm_server_name or ids.server_name(record.label, attempt.attempt)
                    by_cause.setdefault((record.project_id, cause), []).append((attempt.closed, name))
        server_failures = [ServerFailure(*key, len(ends), *max(ends)) for key, ends in by_cause.items()]
        return sorted(server_failures, key=lambda f: (not f.matters, -f.servers, f.project, f.cause))

    def warm(self, project_id: str) -> WarmServers:
        """Count the warm servers of a project."""
        mine = [r for r in self.servers if r.is_warm_server and r.project_id == project_id]
        assigned = [r for r in self._closed_today() if r.reason is Reason.ASSIGNED and r.project_id == project_id]
        return WarmServers(sum(r.state is ServerState.READY for r in mine), len(mine), len(assigned))

    def _closed_today(self) -> list[Server]:
        day = midnight(self.at)
        return [r for r in self.recent if r.closed and r.closed >= day]


class InstallationMonitor:
    """Takes snapshots of one installation again and again. It keeps records and sessions that need no second read."""

    def __init__(self, account: Account, installation: Installation, project_id: str | None = None) -> None:
        self._account = account
        self._installation = installation
        self._project_id = project_id
        self._platform = account.platform(installation)
        self._records = Records(self._platform.documents)
        self._repository = Repository(self._platform.documents)
        self._formed: dict[str, int] = {}  # session → number of its members, which never changes

    def look(self, progress: Callable[[str], None] = lambda _: None) -> Snapshot:
        """Take a snapshot. `progress` gets a text on the progress of a long listing."""
        look = Snapshot(at=datetime.now(UTC))
        parts = {
            "servers": self._servers,
            "tasks": self._tasks,
            "queues": self._queues,
            "certificate": self._certificate,
            "alarms": self._alarms,
        }
        with ThreadPoolExecutor(4) as pool:
            running = [pool.submit(self._try, look, part, read) for part, read in parts.items()]
            self._try(look, "projects", partial(self._projects, progress=progress))
            for server in running:
                server.result()
        look.spent = spent(look.recent, look.at, since=midnight(look.at))
        return look

    def _try(self, look: Snapshot, part: str, read: Callable[[Snapshot], None]) -> None:
        """Call `read`, which adds a part to the snapshot. If AWS refuses, write the reason into `problems`."""
        try:
            read(look)
        except Exception as error:
            problem = explain.problem_from(error)
            if problem is None:
                raise
            look.problems[part] = str(problem)

    def _projects(self, look: Snapshot, progress: Callable[[str], None]) -> None:
        documents = self._platform.documents
        unread: list[UnreadableEntry] = []
        projects = participants.choose(participants.registered_projects(documents, unread), self._project_id)
        for number, entry in enumerate(unread, 1):
            look.problems[f"project {entry.id or number}"] = participants.unreadable(entry)
        for project in projects:

            def advance(count: int, name: str = project.id) -> None:
                if count % 100 == 0:
                    progress(f"{name}: {count:,} participants")

            look.projects.append(
                (project, participants.count_participants(documents, project, midnight(look.at), advance))
            )

    def _servers(self, look: Snapshot) -> None:
        # Servers that may be open, or have failed or cost something today: their records were written within the last
        # day, or within the longest life of a server.
        since = min(look.at - DAY, look.at - timedelta(minutes=self._platform.settings.max_runtime) - SLACK)
        records = [r for r in self._records.since(since) if self._project_id in (None, r.project_id)]
        if self._records.unreadable:
            look.problems["records of servers"] = f"{count(self._records.unreadable, 'record')} cannot be read; {ASK}"
        look.servers = sorted((r for r in records if not r.is_closed), key=lambda r: r.requested)
        look.recent = records
        look.members = {r.name: size for r in look.servers if r.is_of_session and (size := self._size_of_session(r))}

    def _size_of_session(self, server: Server) -> int | None:
        """Return how many members the session of this server has, which never changes; None if it is not formed yet."""
        if server.user_id not in self._formed:
            session = readable_session(self._repository, server.project_id, server.user_id)
            if session is None:
                return None
            self._formed[server.user_id] = len(session.members)
        return self._formed[server.user_id]

    def _tasks(self, look: Snapshot) -> None:
        look.tasks = self._platform.tasks.count()

    def _queues(self, look: Snapshot) -> None:
        look.queues = queues(self._account, self._installation.stack)

    def _certificate(self, look: Snapshot) -> None:
        if self._installation.has_domain:
            look.certificate = certificate(self._installation, self._platform.documents, look.at)

    def _alarms(self, look: Snapshot) -> None:
        all_alarms = alarms(self._account, self._installation)
        look.alarms = [alarm["AlarmName"] for alarm in all_alarms if alarm["StateValue"] == "ALARM"]


def midnight(now: datetime) -> datetime:
    """Return the beginning of the day in UTC, by which AWS bills."""
    return now.astimezone(UTC).replace(hour=0, minute=0, second=0, microsecond=0)


def queues(account: Account, stack: str) -> list[StackQueue]:
    """Read the stack's queues. A queue that another one names in its RedrivePolicy is a dead-letter queue."""
    client = account.client("sqs")
    by_queue: dict[str, Mapping[str, str]] = {}
    for url in Stack(account, stack).ids_of("AWS::SQS::Queue"):
        by_queue[url] = client.get_queue_attributes(QueueUrl=url, AttributeNames=["All"])["Attributes"]
    policies = " ".join(attributes.get("RedrivePolicy", "") for attributes in by_queue.values())
    return [
        StackQueue(
            name=url.rpartition("/")[2],
            waiting=int(attributes.get("ApproximateNumberOfMessages", 0)),
            in_flight=int(attributes.get("ApproximateNumberOfMessagesNotVisible", 0)),
            delayed=int(attributes.get("ApproximateNumberOfMessagesDelayed", 0)),
            dead=f'"{attributes["QueueArn"]}"' in policies,
        )
        for url, attributes in by_queue.items()
    ]


def certificate(installation: Installation, documents: Documents, now: datetime) -> CertificateState | None:
    """Read the certificate that servers fetch, but not its private key. Return None if there is none.

    Raises `Problem` if the document is no certificate.
    """
    from cryptography import x509  # noqa: PLC0415 - takes its time to import

    key = installation.certificate.fullchain
    document = documents.get(key)
    if document is None:
        return None
    try:
        leaf = x509.load_pem_x509_certificates(document.body)[0]
        names = leaf.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        dns = tuple(names.get_values_for_type(x509.DNSName))
    except (ValueError, IndexError):
        raise Problem(f"{key} in the bucket is no certificate.", "Order one: `hippodrome certificate`.") from None
    except x509.ExtensionNotFound:
        dns = ()
    # The issuers of Let's Encrypt's staging have names such as "(STAGING) …".
    issuer = leaf.issuer.rfc4514_string()
    begins, expires = leaf.not_valid_before_utc, leaf.not_valid_after_utc
    return CertificateState(
        names=dns,
        renewal=renew_at(begins, expires),
        expires=expires,
        days_left=(expires - now) // timedelta(days=1),
        staging="STAGING" in issuer.upper() or "Fake LE" in issuer,
    )


def alarms(account: Account, installation: Installation) -> Iterable[Mapping[str, Any]]:
    """Yield the installation's alarms: the alarms that send to its topic."""
    pages = account.client("cloudwatch").get_paginator("describe_alarms")
    for page in pages.paginate(ActionPrefix=installation["Alarms"]):
        yield from page.get("MetricAlarms", ())


def subscriptions(account: Account, installation: Installation) -> Iterable[Mapping[str, Any]]:
    """Yield the subscriptions of the alarms' topic. A confirmed subscription has an ARN."""
    pages = account.client("sns").get_paginator("list_subscriptions_by_topic")
    for page in pages.paginate(TopicArn=installation["Alarms"]):
        yield from page["Subscriptions"]
