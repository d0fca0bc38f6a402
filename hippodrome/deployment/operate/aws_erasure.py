"""Erases one participant on AWS: first their servers end, then their documents are erased; a last look proves it.

Several participants play on their session's server. It is stopped like a server of the participant's own.

A trial that is told to stop still stores recordings, and its presigned requests
(`hippodrome/control/servers/signing.py`) stay valid for a while. So the documents are erased only when nothing that a
server was allowed to store can arrive any more. If the participant comes back meanwhile, the next round erases that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.model import ids
from hippodrome.control.model.server import Server
from hippodrome.control.servers.leftovers import Scope
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import participants
from hippodrome.deployment.core.server_records import warm_servers_of
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.operate.eraser import Eraser, FoundSession
from hippodrome.deployment.operate.stop import Stopper

ROUNDS = 6  # rounds of erasing and looking again, at most
WAIT = 240  # seconds until a task must have ended: its stopTimeout is 120, and AWS needs some more
SIGNING = 30  # seconds that `sign_requests` may take from reading a server's record to signing


class AwsErasure:
    """Erases one participant of one project from an installation. May be interrupted anywhere and run again."""

    def __init__(
        self, account: Account, installation: Installation, project: str, user: str, executor: Executor | None = None
    ) -> None:
        self.project, self.place = project, installation.stack
        self.eraser = Eraser(VersionedBucket(account, installation["Bucket"]), project, user, plays=self._plays)
        self.ended: dict[str, int] = {}  # the servers that the first look found, and their resources, by kind
        self.playing = 0  # sessions of theirs that play now, as the last look found
        self._platform = account.platform(installation)
        self._executor = executor or Executor()

    def look(self) -> dict[str, int]:
        """Return how much there is of the participant, by kind. Changes nothing."""
        found = self.eraser.look()
        self.playing = sum(self._plays(session.id) for session in found.sessions)
        servers = self._stopper(found.sessions).look().counts()
        self.ended = self.ended or servers
        return {**found.counts(), **servers}

    def run(self, advance: Callable[[int], object] = lambda number: None) -> dict[str, int]:
        """Erase until a look finds nothing, in `ROUNDS` rounds at most. Return what the last look found.

        Raises `Problem` if a server does not end.
        """
        for _ in range(ROUNDS):
            self._end_servers(self.eraser.sessions())
            self.eraser.erase(advance)
            left = self.look()
            if not any(left.values()):
                break
        return left

    def _plays(self, session: str) -> bool:
        record = self.eraser.record(session)
        return record is not None and not record.is_closed

    def _owners(self, sessions: Iterable[FoundSession]) -> dict[str, Server | None]:
        """Return the records of the servers of the participant and of these sessions, by their labels."""
        owners = [self.eraser.user, *(session.id for session in sessions)]
        return {ids.server_label(self.project, owner): self.eraser.record(owner) for owner in owners}

    def _stopper(self, sessions: Iterable[FoundSession]) -> Stopper:
        owners = self._owners(sessions)
        names = frozenset(name for record in owners.values() for name in warm_servers_of(record))
        return Stopper(self._platform, Scope(labels=frozenset(owners), names=names), self._executor)

    def _end_servers(self, sessions: Sequence[FoundSession]) -> None:
        """End the servers and remove what belongs to them; wait until none of them can store anything any more."""
        from hippodrome.control.servers.dns import delete_dns_records  # noqa: PLC0415 - imports Powertools, which other commands do without
        from hippodrome.control.servers.signing import STORE_AFTER_CLOSE, VALID_SECONDS  # noqa: PLC0415 - as above

        stopper = self._stopper(sessions)
        if stopper.run(WAIT):
            raise Problem(
                "Their server has been told to stop and still runs; their documents were not touched.",
                "Wait a few minutes and run the same command again: it goes on from there.",
                list(stopper.errors),
            )
        records = [record for record in self._owners(sessions).values() if record is not None]
        delete_dns_records(self._platform, [record.dns_record for record in records])  # no listing has all names
        ends = [record.closed for record in records if record.closed is not None]
        if ends:
            over = (self._platform.now() - max(ends)).total_seconds()
            seconds = STORE_AFTER_CLOSE.total_seconds() + VALID_SECONDS + SIGNING - over
            if seconds > 0:
                screen.info(f"{seconds:.0f} seconds more: until then a server of theirs might store something.")
                self._executor.sleep(seconds)


def erasures(account: Account, installation: Installation, only: str | None, user: str) -> list[AwsErasure]:
    """Return an erasure for each project of the installation, or for the project `only`.

    Raises `Problem` for an unknown project: a mistyped id must not look like an erasure.
    """
    known = _projects(account, installation)
    if only not in (None, *known):
        raise Problem(
            f"The installation {installation.stack} holds nothing of a project {only}.",
            f"Name another, or take --everywhere. It holds: {', '.join(known) or 'nothing yet'}.",
        )
    return [AwsErasure(account, installation, project, user) for project in known if only in (None, project)]


def about(account: Account, installation: Installation) -> dict[str, str]:
    """Return the facts about this place for a receipt."""
    place = {"stack": installation.stack, "region": installation.region, "bucket": installation["Bucket"]}
    return {**place, "by": account.identity["Arn"]}


def _projects(account: Account, installation: Installation) -> list[str]:
    """Return the ids of all projects that are registered or have documents in the bucket."""
    names = {project.id for project in participants.registered_projects(account.platform(installation).documents)}
    names.update(VersionedBucket(account, installation["Bucket"]).folders())
    return sorted(name for name in names if ids.is_project_id(name))
