"""What `task_changed` does for tasks that run: addresses, DNS names, and `ready` once everybody knows those.

It asks by messages to itself whether a change of names is known everywhere. Lambda takes a chain of those for a loop:
by default it drops the next invocation after about 16 (Lambda Developer Guide, "Use Lambda recursive loop detection";
the count travels in the trace header that AWS's SDKs send along, and nothing is said of whose count a batch inherits).
The template allows the function its loop, and `MOST_LOOKS` ends it here. Fewer looks would not do instead: where many
come, batches hand the highest count on, and people wait for each pause (the simulation has shown both). A server whose
message is lost is found by the sweep, which begins anew (`overdue.py`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from hippodrome.log import failure, logger
from hippodrome.model import ids, messages, server
from hippodrome.model.messages import DnsChanged, Named, TaskChanged, TaskSeen, to_message
from hippodrome.model.server import Server, State
from hippodrome.ports import Address, Busy, DnsRecord, Platform, RefusedDnsRecords
from hippodrome.servers.batches import each
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.repository import Repository, Versioned

PAUSES = (18, *[3] * 34)  # seconds before each look for two minutes; names are seldom known sooner than 18 s
LATER = 30  # seconds between the looks after those
MOST_LOOKS = 51  # ten minutes of asking
LOOK_AGAIN = 3  # seconds until a name is made for which the zone was too busy, or an address is asked for once more
MOST_ADDRESS_LOOKS = 5  # for the address of a network interface, before the queue brings the event again
UNNAMED = (State.STARTING, State.NAMING)
GOING = (State.DRAINING, State.CLOSED)
MOST_MADE = 400  # names of servers in one message
MOST_KEPT = 1000  # records remembered between a server's naming and its being ready


class DnsRegistration:
    """Gives running servers their names, many with one change."""

    def __init__(self, platform: Platform, repository: Repository, pools: Pools) -> None:
        self._platform = platform
        self._repository = repository
        self._pools = pools
        self._written: dict[tuple[str, int], Versioned] = {}  # by label and attempt: warm servers for their names

    def running(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """One look for all addresses and one DNS change for all names; the events that should come again."""
        waiting, again = each(
            self._platform, events, self._to_name, "a running task is not dealt with yet", lambda event: event.name
        )
        if not waiting:
            return again
        addresses = self._platform.tasks.addresses([event.interface for event, _ in waiting if event.interface])
        placed = {event: address for event, _ in waiting if (address := addresses.get(event.interface or ""))}
        again += self._place_later([event for event, _ in waiting if event not in placed])
        stored = dict(waiting)
        named, failed = each(
            self._platform,
            placed,
            lambda event: self._name(stored[event], event, placed[event]),
            "a running task is not named yet",
            lambda event: event.name,
        )
        nameless = {record.name for record in self._make([record for _, record in named])}
        return again + failed + [event for event, record in named if record.name in nameless]

    def _place_later(self, events: Sequence[TaskChanged]) -> list[TaskChanged]:
        """Addresses that EC2 does not know yet are asked for in a moment; those events for which that is no use."""
        soon = [event for event in events if event.interface and event.looked < MOST_ADDRESS_LOOKS]
        for event in soon:
            seen = TaskSeen(event.task, event.cluster, event.name, event.interface or "", event.looked + 1)
            self._platform.bus.later(to_message(seen), LOOK_AGAIN)
        return [event for event in events if event not in soon]

    def _make(self, servers: Sequence[Server], looked: int = 0) -> list[Server]:
        """Make the names that are written down; the servers that cannot have one.

        While the zone is busy the names wait, and are made together with others.

        The names do not wait for the queue: that would bring the events again only after its visibility timeout, and
        after some receives not any more.
        """
        nameless: list[Server] = []
        for batch in (servers[n : n + MOST_MADE] for n in range(0, len(servers), MOST_MADE)):
            named = [Named(record.label, record.attempt) for record in batch]
            try:
                change = self._platform.dns.change(add=[record.dns_record for record in batch if record.dns_record])
            except Busy:
                if looked >= MOST_LOOKS:
                    raise
                again = DnsChanged("", named, looked + 1, unmade=True)
                self._platform.bus.later(to_message(again), LOOK_AGAIN)
            except RefusedDnsRecords as refused:
                others = [record for record in batch if record.dns_record not in refused.records]
                if others:
                    self._in_sync(DnsChanged(refused.change, [Named(one.label, one.attempt) for one in others]))
                nameless += self._rename([record for record in batch if record.dns_record in refused.records], looked)
            else:
                self._in_sync(DnsChanged(change, named))
        return nameless

    def _rename(self, servers: Sequence[Server], looked: int) -> list[Server]:
        """Give servers whose names the zone will not take their usual ones, that are nobody else's; those it cannot."""
        for record in servers:
            logger.error("the zone refuses a server's name", extra={"server": record.name, "usual": record.is_usual})
        renamed, failed = each(
            self._platform,
            [record for record in servers if not record.is_usual],
            self._call_as_usual,
            "a server is not renamed yet",
            lambda record: record.name,
        )
        nameless = self._make([record for _, record in renamed], looked) if renamed else []
        return [record for record in servers if record.is_usual] + failed + nameless

    def _call_as_usual(self, record: Server) -> Server | None:
        after = self._repository.update(
            self._repository.server(record.label),
            lambda r: server.renamed(r) if r.owns(record.name) and r.state is State.NAMING else None,
        )
        return after.server if after else None

    def _to_name(self, event: TaskChanged) -> Versioned | None:
        """The record of a task that runs and has no name yet. A task that nobody waits for is stopped."""
        stored = self._repository.owner(event.name)
        if stored is None:
            return None  # not of this installation
        record = stored.server
        waits = record.name == event.name and record.state not in GOING
        if not waits or record.task not in (None, event.task):
            self._platform.tasks.stop(event.task, event.cluster, f"{messages.OUR_STOP} nobody waits for it")
            return None
        return stored if record.state in UNNAMED and not record.warm_server else None

    def _name(self, stored: Versioned, event: TaskChanged, address: Address) -> Server | None:
        """Write down the name before it is made. None if nobody waits for it any more."""
        now = self._platform.now()
        after = self._repository.update(
            stored,
            lambda r: server.naming(r, event.task, address, now) if r.owns(event.name) and r.state in UNNAMED else None,
        )
        if after is None:
            return None
        if len(self._written) >= MOST_KEPT:
            self._written.clear()
        self._written[after.server.label, after.server.attempt] = after
        return after.server

    def dns_changed(self, *messages: DnsChanged) -> list[DnsChanged]:
        """The follow-ups of DNS changes: are their names known everywhere? Those that should come again.

        All are looked at together, since running tasks wait in the same batch for their names.
        """
        unmade = [message for message in messages if message.unmade]
        made = [message for message in messages if not message.unmade]
        in_sync, again = each(self._platform, made, self._look, "a change of names cannot be looked at")
        again += self._make_again(unmade) if unmade else []
        try:
            self._ready({named: message.looked for message, _ in in_sync for named in message.servers})
        except Exception as error:  # noqa: BLE001 - the changes that are looked at later are not to come twice
            failure("servers are not ready yet", error)
            again += [message for message, _ in in_sync]
        return again

    def _make_again(self, unmade: Sequence[DnsChanged]) -> list[DnsChanged]:
        """Make the names for which the zone was too busy, all with one change; the messages that should come again."""
        wanted = {(named.label, named.attempt): named for message in unmade for named in message.servers}
        waiting, failed = each(
            self._platform,
            wanted.values(),
            self._waits,
            "a name is not made yet",
            lambda named: ids.server_name(named.label, named.attempt),
        )
        try:
            made = self._make([record for _, record in waiting], max((message.looked for message in unmade), default=0))
        except Exception as error:  # noqa: BLE001 - the looks at other changes are not to come twice
            failure("names are not made yet", error)
            return list(unmade)
        failed += [Named(record.label, record.attempt) for record in made]
        return [message for message in unmade if any(named in failed for named in message.servers)]

    def _waits(self, named: Named) -> Server | None:
        """The record of a server that still waits for its name."""
        stored = self._repository.server(named.label)
        waits = stored and stored.server.is_open(named.attempt) and stored.server.state is State.NAMING
        return stored.server if stored and waits else None

    def _look(self, message: DnsChanged) -> bool | None:
        """True if the names are known everywhere; else None, and it is looked again later."""
        try:
            if not message.change or self._platform.dns.in_sync(message.change):
                return True
        except Busy:
            logger.warning("a change of names is looked at later", extra={"servers": len(message.servers)})
        self._look_later(message)
        return None

    def _in_sync(self, message: DnsChanged) -> None:
        """After a change: an empty id says that it is in sync already."""
        if message.change:
            self._look_later(message)
        else:
            self._ready(dict.fromkeys(message.servers, message.looked))

    def _look_later(self, message: DnsChanged) -> None:
        """Look once more, but not for ever: the sweep finds the servers that are left."""
        if message.looked >= MOST_LOOKS:
            logger.error("names do not get in sync", extra={"servers": len(message.servers)})
            return
        again = DnsChanged(message.change, message.servers, message.looked + 1)
        self._platform.bus.later(to_message(again), pause(message.looked))

    def _ready(self, servers: Mapping[Named, int]) -> None:
        """Hand out the addresses, by how often was looked; a server closed meanwhile loses the name that was made."""
        late, failed = each(
            self._platform,
            servers,
            self._late,
            "a server is not ready yet",
            lambda named: ids.server_name(named.label, named.attempt),
        )
        if late:
            self._platform.dns.change(remove=[record for _, record in late])
        if failed:  # the change is in sync: those that remain are looked at once more
            self._look_later(DnsChanged("", failed, max(1, *(servers[named] for named in failed))))

    def _late(self, named: Named) -> DnsRecord | None:
        """Write `ready`; if the server was closed meanwhile, the name that is to go again."""
        name = ids.server_name(named.label, named.attempt)
        made = self._make_ready(named)
        if made:
            logger.info("server ready", extra={"server": name})
        found = made or self._repository.owner(name)
        if found is None or found.server.name != name:
            return None
        record = found.server
        if record.is_warm_server and record.state is State.READY:  # also if that was cut off the last time
            self._pools.ready(record.project_id, record.user_id)
        return record.dns_record if record.state in GOING else None

    def _make_ready(self, named: Named) -> Versioned | None:
        """Write `ready` if the server still waits for its name. The version we wrote last is tried first, unread."""
        now = self._platform.now()
        stored = self._written.pop((named.label, named.attempt), None) or self._repository.server(named.label)
        return self._repository.update(
            stored,
            lambda r: server.ready(r, now) if r.is_open(named.attempt) and r.state is State.NAMING else None,
        )


def pause(looked: int) -> int:
    """Seconds until the next look, after so many: the longer it takes, the less often is asked."""
    return PAUSES[looked] if looked < len(PAUSES) else LATER
