"""Creates and deletes the DNS records of servers.

`task_changed` finds the addresses of running tasks, creates their DNS records, and marks the servers `ready`. A
server's record is deleted when the server ends (`termination.py`). The sweep and the commands delete leftovers.

The function sends itself messages to check whether a DNS change is INSYNC. Lambda takes such a chain for a loop, and by
default drops the next invocation after about 16 (Lambda Developer Guide, "Use Lambda recursive loop detection"; the
count is in the trace header that AWS's SDKs send, and the guide does not say which count a batch inherits). The
template allows this function its loop, and `MAX_CHECKS` ends it. Fewer checks with longer pauses would not stay below
16 either: in the simulation, a batch of messages from many chains inherits the highest of their counts. And
participants wait for each pause. If a message is lost, the sweep starts the chain again (`overdue.py`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from hippodrome.control.log import failure, logger
from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.messages import DnsChanged, ServerAttempt, TaskChanged, TaskSeen, to_message
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.ports import Address, DnsRecord, Platform, RefusedDnsRecords, ServiceBusy
from hippodrome.control.servers.batches import for_each
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.storage.repository import Versioned

PAUSES = (18, *[3] * 34)  # seconds before each check, for two minutes; a change is seldom INSYNC before 18 s
LONG_PAUSE = 30  # seconds between later checks
MAX_CHECKS = 51  # the most checks of one change: they take ten minutes
RETRY_PAUSE = 3  # seconds until the next try if the zone was busy, or if an interface had no public address yet
MAX_ADDRESS_CHECKS = 5  # checks for one network interface; after them the queue delivers the event again
BEFORE_READY = (ServerState.STARTING, ServerState.NAMING)
DRAINING_OR_CLOSED = (ServerState.DRAINING, ServerState.CLOSED)
MAX_SERVERS_PER_CHANGE = 400  # as many as one message can name
MAX_CACHED = 1000  # records kept between the states `naming` and `ready`


def delete_dns_records(platform: Platform, records: Iterable[DnsRecord | None]) -> None:
    """Delete these DNS records, with exactly these values, by one change. If all are None, nothing is called."""
    existing = [record for record in records if record is not None]
    if existing:
        platform.dns.change(remove=existing)


class DnsRecords:
    """Creates the DNS records of running servers, many with one change."""

    def __init__(self, services: ServerServices) -> None:
        self._platform = services.platform
        self._repository = services.repository
        self._pools = services.pools
        self._written = services.written

    def tasks_running(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Create the DNS records of the servers in these RUNNING events; return the events to deliver again.

        One call finds all addresses, and one DNS change creates all records.
        """
        waiting, again = for_each(
            self._platform,
            events,
            self._record_to_register,
            "a running task is not handled yet",
            lambda event: event.name,
        )
        if not waiting:
            return again
        addresses = self._platform.tasks.addresses([event.interface for event, _ in waiting if event.interface])
        addressed = {event: address for event, _ in waiting if (address := addresses.get(event.interface or ""))}
        again += self._retry_addresses([event for event, _ in waiting if event not in addressed])
        stored = dict(waiting)
        ready_attempts, failed = for_each(
            self._platform,
            addressed,
            lambda event: self._write_naming(stored[event], event, addressed[event]),
            "the state naming is not written yet",
            lambda event: event.name,
        )
        unregistered = {record.name for record in self._create([record for _, record in ready_attempts])}
        return again + failed + [event for event, record in ready_attempts if record.name in unregistered]

    def _retry_addresses(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Send messages to look the addresses up again after `RETRY_PAUSE`; return the events to deliver again instead.

        These are the events without an interface, and those whose address was looked up `MAX_ADDRESS_CHECKS` times.
        """
        soon = [event for event in events if event.interface and event.looked < MAX_ADDRESS_CHECKS]
        for event in soon:
            task_seen = TaskSeen(event.task, event.cluster, event.name, event.interface or "", event.looked + 1)
            self._platform.bus.send_delayed(to_message(task_seen), RETRY_PAUSE)
        return [event for event in events if event not in soon]

    def _create(self, servers: Sequence[Server], looked: int = 0) -> list[Server]:
        """Create the DNS records of servers in state `naming`; return the servers that cannot have one.

        If the zone is busy, a delayed message repeats the change. The queue is no alternative: it delivers the events
        again only after its visibility timeout, and not at all after some receives.
        """
        unregistered: list[Server] = []
        servers = [record for record in servers if record.dns]  # the others wait for a certificate (`certifying.py`)
        for batch in (servers[n : n + MAX_SERVERS_PER_CHANGE] for n in range(0, len(servers), MAX_SERVERS_PER_CHANGE)):
            attempts = [_attempt_of(record) for record in batch]
            try:
                change = self._platform.dns.change(add=[record.dns_record for record in batch if record.dns_record])
            except ServiceBusy:
                if looked >= MAX_CHECKS:
                    raise
                unmade = DnsChanged("", attempts, looked + 1, unmade=True)
                self._platform.bus.send_delayed(to_message(unmade), RETRY_PAUSE)
            except RefusedDnsRecords as refused:
                created = [_attempt_of(record) for record in batch if record.dns_record not in refused.records]
                if created:
                    self._after_change(DnsChanged(refused.change, created))
                to_rename = [record for record in batch if record.dns_record in refused.records]
                unregistered += self._rename(to_rename, looked)
            else:
                self._after_change(DnsChanged(change, attempts))
        return unregistered

    def _rename(self, servers: Sequence[Server], looked: int) -> list[Server]:
        """Give servers their default name if the zone refuses theirs; return the servers that cannot be renamed."""
        for record in servers:
            logger.error(
                "the zone refuses a server's name", extra={"server": record.name, "usual": record.has_default_name}
            )
        renamed, failed = for_each(
            self._platform,
            [record for record in servers if not record.has_default_name],
            self._use_default_name,
            "a server is not renamed yet",
            lambda record: record.name,
        )
        unregistered = self._create([record for _, record in renamed], looked)
        return [record for record in servers if record.has_default_name] + failed + unregistered

    def _use_default_name(self, record: Server) -> Server | None:
        after = self._repository.update(
            self._repository.server(record.label),
            lambda r: server.with_default_name(r) if r.owns(record.name) and r.state is ServerState.NAMING else None,
        )
        return after.server if after else None

    def _record_to_register(self, event: TaskChanged) -> Versioned | None:
        """Return the record of a running task's server if it has no DNS record yet; else None.

        Stop the task if its server is closed or draining, or has another task.
        """
        stored = self._repository.owner(event.name)
        if stored is None:
            return None  # the task is not this installation's
        record = stored.server
        waits = record.name == event.name and record.state not in DRAINING_OR_CLOSED
        if not waits or record.task not in (None, event.task):
            self._platform.tasks.stop(event.task, event.cluster, f"{messages.STOP_REASON_PREFIX} no server needs it")
            return None
        return stored if record.state in BEFORE_READY and not record.warm_server_name else None

    def _write_naming(self, stored: Versioned, event: TaskChanged, address: Address) -> Server | None:
        """Write the state `naming` before the DNS record is created; None if the server was closed meanwhile."""
        now = self._platform.now()
        after = self._repository.update(
            stored,
            lambda r: (
                server.naming(r, event.task, address, now) if r.owns(event.name) and r.state in BEFORE_READY else None
            ),
        )
        if after is None:
            return None
        if len(self._written) >= MAX_CACHED:
            self._written.clear()
        self._written[after.server.label, after.server.attempt] = after
        return after.server

    def dns_changed(self, batch: Sequence[DnsChanged]) -> list[DnsChanged]:
        """Mark the servers of changes that are INSYNC `ready`; return the messages that should be delivered again.

        All messages are handled at once, because running tasks in the same batch wait for their DNS records.
        """
        unmade = [message for message in batch if message.unmade]
        insync = [message for message in batch if not message.unmade]
        in_sync, again = for_each(self._platform, insync, self._check, "a DNS change could not be checked")
        again += self._retry_create(unmade) if unmade else []
        try:
            self._complete({server: message.looked for message, _ in in_sync for server in message.servers})
        except Exception as error:  # noqa: BLE001 - messages for which the next check was sent must not come again
            failure("servers are not ready yet", error)
            again += [message for message, _ in in_sync]
        return again

    def _retry_create(self, unmade: Sequence[DnsChanged]) -> list[DnsChanged]:
        """Create the DNS records for which the zone was busy, with one change; return the messages to deliver again."""
        waiting, failed = for_each(
            self._platform,
            dict.fromkeys(server for message in unmade for server in message.servers),
            self._waiting_record,
            "a DNS record is not created yet",
            lambda attempt_named: ids.server_name(attempt_named.label, attempt_named.attempt),
        )
        try:
            unregistered = self._create([record for _, record in waiting], max(message.looked for message in unmade))
        except Exception as error:  # noqa: BLE001 - the checks of other changes must not come twice
            failure("DNS records are not created yet", error)
            return list(unmade)
        failed += map(_attempt_of, unregistered)
        return [message for message in unmade if any(server in failed for server in message.servers)]

    def _waiting_record(self, server_attempt: ServerAttempt) -> Server | None:
        """The record of a server that is still in state `naming`; else None."""
        stored = self._repository.server(server_attempt.label)
        waits = stored and stored.server.is_open(server_attempt.attempt) and stored.server.state is ServerState.NAMING
        return stored.server if stored and waits else None

    def _check(self, message: DnsChanged) -> bool | None:
        """Return True if the change is INSYNC. Otherwise send the message of the next check and return None."""
        try:
            if not message.change or self._platform.dns.in_sync(message.change):
                return True
        except ServiceBusy:
            logger.warning("the zone is busy: a DNS change is checked later", extra={"servers": len(message.servers)})
        self._check_later(message)
        return None

    def _after_change(self, message: DnsChanged) -> None:
        """Send the message of a change's first check. A change without id is INSYNC: its servers become ready now."""
        if message.change:
            self._check_later(message)
        else:
            self._complete(dict.fromkeys(message.servers, message.looked))

    def _check_later(self, message: DnsChanged) -> None:
        """Send the message of the next check. After `MAX_CHECKS`, log an error instead: the sweep finds the servers."""
        if message.looked >= MAX_CHECKS:
            logger.error("a DNS change did not become INSYNC in time", extra={"servers": len(message.servers)})
            return
        again = DnsChanged(message.change, message.servers, message.looked + 1)
        self._platform.bus.send_delayed(to_message(again), pause(message.looked))

    def _complete(self, servers: Mapping[ServerAttempt, int]) -> None:
        """Mark these servers ready; delete the DNS records of servers that were closed or drained before.

        `servers` maps each server to the number of checks so far.
        """
        late, failed = for_each(
            self._platform,
            servers,
            self._make_ready,
            "a server is not ready yet",
            lambda server: ids.server_name(server.label, server.attempt),
        )
        delete_dns_records(self._platform, [record for _, record in late])
        if failed:  # the next check only tries these servers again, since the change is INSYNC
            self._check_later(DnsChanged("", failed, max(1, *(servers[name] for name in failed))))

    def _make_ready(self, server_attempt: ServerAttempt) -> DnsRecord | None:
        """Write `ready`, and mark a warm server ready in its pool. If the server was closed, return its DNS record."""
        name = ids.server_name(server_attempt.label, server_attempt.attempt)
        written = self._write_ready(server_attempt)
        if written:
            logger.info("server ready", extra={"server": name})
        owner = written or self._repository.owner(name)
        if owner is None or owner.server.name != name:
            return None
        record = owner.server
        # Even if `ready` was written before: that call may have been interrupted before it changed the pool.
        if record.is_warm_server and record.state is ServerState.READY:
            self._pools.mark_ready(record.project_id, record.user_id)
        return record.dns_record if record.state in DRAINING_OR_CLOSED else None

    def _write_ready(self, server_attempt: ServerAttempt) -> Versioned | None:
        """Write `ready` if the state is still `naming`. The version written last is used first, without a read."""
        now = self._platform.now()
        stored = self._written.pop((server_attempt.label, server_attempt.attempt), None) or self._repository.server(
            server_attempt.label
        )
        return self._repository.update(
            stored,
            lambda r: (
                server.ready(r, now) if r.is_open(server_attempt.attempt) and r.state is ServerState.NAMING else None
            ),
        )


def _attempt_of(record: Server) -> ServerAttempt:
    return ServerAttempt(record.label, record.attempt)


def pause(looked: int) -> int:
    """Return the seconds to wait before the next check of a change: one of `PAUSES`, then `LONG_PAUSE`.

    `looked` is how many checks there were.
    """
    return PAUSES[looked] if looked < len(PAUSES) else LONG_PAUSE
