"""Conditions that must hold after every step, and at the end of a run."""

from __future__ import annotations

from collections import Counter
from datetime import timedelta

from hippodrome.control.limits.rules import ServerSlots, server_slots_key
from hippodrome.control.model import ids
from hippodrome.control.model.messages import STOP_REASON_PREFIX
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import AUTOMATIC_ATTEMPTS, MAX_ATTEMPTS, Server, ServerState
from tests.stateful.account import Task
from tests.stateful.world import RECEIVES, STRANGER, VISIBILITY, World

STEP = 5  # seconds between two checks whether something is left to do
MAX_LOOKS = 400
CACHES = 11  # seconds for which functions may read old data in their caches
PATIENCE = timedelta(minutes=75)  # the time for which a participant tries again


def always(world: World) -> None:
    """Check what must hold after every step; it costs little time."""
    assert not world.wrong, world.wrong
    answers_stay(world)
    strangers_stay(world)
    places_hold(world)
    warm_servers_are_given_once(world)
    for record in world.records():
        if not record.is_closed:
            one_task(world, record)
            if not world.pending(record):
                owned(world, record)
        elif not world.functions.waiting:
            world.excused.discard(record.label)
            world.unheard.discard(record.label)


def answers_stay(world: World) -> None:
    """A stored answer is never changed or deleted."""
    for key, body in world.kept.items():
        assert world.account.kept.get(key, (b"",))[0] == body, f"an answer changed: {key}"
    world.kept.update({key: kept[0] for key, kept in world.account.kept.items() if "/answers/" in key})


def strangers_stay(world: World) -> None:
    """Resources of others are as they were at the beginning."""
    account, there = world.account, world.strangers
    assert any(task.name == STRANGER and task.alive for task in account.fleet.tasks.values())
    assert there["names"] <= set(account.zone.records)
    assert there["timers"] <= set(account.due)
    assert there["clusters"] <= account.fleet.own_clusters


def places_hold(world: World) -> None:
    """Limits are never exceeded."""
    project, kept = world.project, world.account.kept
    if project.max_participants is not None:
        assert sum(key.endswith("/participant.json") for key in kept) <= project.max_participants
    found = kept.get(server_slots_key(project.id))
    running = from_json(found[0], ServerSlots) if found else ServerSlots()
    people = [held for held in running.slots.values() if not held.is_warm_server]
    if project.max_servers is not None:
        assert len(people) <= project.max_servers
        assert len(running.slots) <= project.max_servers + project.warm_servers
    if project.max_server_hours is not None and not project.warm_servers:
        assert running.used + sum(held.reserved for held in people) <= project.max_server_hours * 3600


def warm_servers_are_given_once(world: World) -> None:
    """A warm server is assigned to one participant for good, and its trial is told so."""
    plays = Counter(
        record.warm_server_name
        for record in world.records()
        if record.warm_server_name and record.state is ServerState.READY
    )
    assert all(count == 1 for count in plays.values()), f"a warm server is given twice: {plays}"
    for record in world.records():
        if record.assigned_to:
            assert world.given.setdefault(record.name, record.assigned_to) == record.assigned_to
    for name, handover in world.handovers().items():
        label = ids.server_label(world.project.id, handover.user_id)
        assert world.given.get(name) == label, f"{world.who(name)} is told to be {handover.user_id}'s, and is not"


def tasks_of(world: World, record: Server) -> list[Task]:
    return [task for task in world.tasks if task.name == record.name]


def one_task(world: World, record: Server) -> None:
    """The first task of a server is recorded; a second one is stopped as soon as its event comes."""
    running = [task for task in tasks_of(world, record) if task.alive and task.last == "RUNNING"]
    for task in running:
        told = record.label in world.unheard or any(
            m.body.get("detail", {}).get("taskArn") == task.arn for m in [*world.queued, *world.in_flight]
        )
        known = record.task in (None, task.arn)
        assert known or told or world.functions.waiting, f"two tasks run for {world.who(record.name)}"
    assert record.task is None or record.task in {task.arn for task in tasks_of(world, record)}


def owned(world: World, record: Server) -> None:
    """No message is on its way to this server: it has all its resources, or the sweep will notice its end.

    A participant who comes back right after an erasure has a server of the same name: a late event of the earlier server's end
    may remove its timer or its slot. The sweep ends it after its deadline.
    """
    if record.label in world.erased:
        return
    account, name = world.account, world.who(record.name)
    living = [task for task in tasks_of(world, record) if task.alive]
    over = account.now() > record.deadline
    if record.state is ServerState.READY:
        task = account.fleet.tasks[record.task or ""]
        if task.alive:
            assert account.zone.records.get(record.dns) == record.host, f"{name} is ready and has no name"
        else:
            to_come = not task.ended and not task.reason.startswith(STOP_REASON_PREFIX)
            assert to_come or over, f"{name} is ready, its task is gone, and nobody will tell"
    if living and not over:
        assert record.name in account.due, f"{name} runs without a timer"
        # One of two deliveries is refused while the other gets a warm server.
        if record.counted and not record.warm_server_name:
            held = from_json(account.kept[server_slots_key(record.project_id)][0], ServerSlots).slots
            assert record.label in held, f"{name} runs without a place"


# At the end


def settle(world: World) -> None:
    """Deliver all messages, without faults, until nothing is left to do. Time passes meanwhile."""
    account = world.account
    fleet = account.fleet
    fleet.spot = fleet.demand = "room"
    fleet.lag, fleet.addresses_known = 0, True
    for _ in range(MAX_LOOKS):
        while world.functions.waiting:
            world.functions.go_on(world.functions.waiting[0])
        account.zone.settle()
        for queue in ("start", "tasks", "stop"):
            _deliver(world, queue)
        moving = world.move_all()
        due = world.timers_due()
        for timer in due:
            world.fire(timer)
        if not (world.queued or moving or due):
            return
        if not world.visible():
            world.wait(STEP)
    raise AssertionError(f"it does not come to rest: {world.queued}")


def _deliver(world: World, queue: str) -> None:
    """Deliver all messages of a queue; those that fail come again after a while, and become dead letters in the end."""
    there, now = world.visible(queue), world.account.now()
    for batch in [[one] for one in there] if queue == "start" else [there] if there else []:
        world.deliver(batch)
    for message in [message for message in world.queued if message in there]:
        message.visible = now + timedelta(seconds=VISIBILITY)
        if message.failed >= RECEIVES:
            world.queued.remove(message)
            world.dead.append(message)


def ends_well(world: World) -> None:
    """Check that every participant finishes or sees why not, and that nothing is left."""
    for waiting in [*world.functions.waiting]:
        world.functions.go_on(waiting)
    for message in world.queued:
        message.failed = 0
    for _ in range(RECEIVES):  # the command says that it must be repeated
        if world.excused:
            world.excused.clear()
            world.stop_all()
            world.move_all()
            world.wait(20)
    settle(world)
    world.wait(CACHES)
    always(world)
    for user in world.people:
        walk(world, user)
    nothing_left(world)
    for user in world.people:
        page = world.ask(user)
        assert is_last_or_true(world, user, page), f"in the end {user} sees {page}"


def nothing_left(world: World) -> None:
    """Check that after all deadlines and two sweeps nothing is left. A study with warm servers is closed first."""
    if world.project.warm_servers:
        world.open(False, heard=False)
    for _ in range(AUTOMATIC_ATTEMPTS + 1):
        world.tell("long after")
        world.wait(3 * 3600)
        for _ in range(2):
            settle(world)
            world.sweep()
            settle(world)
            world.wait(11 * 60)
        always(world)
        if not any(world.left().values()):
            break
    left = {what: found for what, found in world.left().items() if found}
    assert not left, f"left behind: {left}"


def walk(world: World, user: str) -> None:
    """Let the participant go on from any step to the end, as far as possible."""
    until, swept, restarts = world.account.now() + PATIENCE, world.account.now(), Counter[str]()
    while world.account.now() < until:
        page = world.ask(user)
        step = page.get("step")
        if "state" in page:
            if page["state"] == "ready":
                play(world, user, page)
            elif page["state"] in ("ended", "failed"):
                if not page["again"] or restarts[page["reason"]] == MAX_ATTEMPTS:
                    break
                restarts[page["reason"]] += 1
                world.restart(user)
            world.wait(35)
        elif step is None or step == world.project.final.key:
            break
        else:
            world.answer(user, step)
        settle(world)
        if world.account.now() - swept > timedelta(minutes=5):
            world.sweep()
            swept = world.account.now()
    assert is_last_or_true(world, user, page), f"{user} waits for ever: {page}"
    if not world.project.limits_servers:
        assert not page.get("again"), f"{user} asks again and again: {page}"


def play(world: World, user: str, page: dict[str, object]) -> None:
    """Connect and play, if a server answers at that address."""
    for task in running_at(world, str(page["url"])):
        assert task.request.environment["TOKEN"] == page["token"]
        assert world.player(task) == user
        world.played(task)
        world.account.fleet.end(task, "EssentialContainerExited", "done", 0)


def running_at(world: World, url: str) -> list[Task]:
    """Return the tasks that run at this address."""
    host = world.account.zone.records.get(url.split("/")[2].split(":", maxsplit=1)[0])
    return [task for task in world.tasks if task.host == host and task.last == "RUNNING" and task.alive]


def is_last_or_true(world: World, user: str, page: dict[str, object]) -> bool:
    """Return whether this is the last page, or one that correctly says why the participant cannot go on."""
    if page.get("step") == world.project.final.key:
        return True
    if "message" in page:
        closed, full = not world.project.live, world.project.max_participants is not None
        return (closed and "Study not found" in str(page["message"])) or (full and "full" in str(page["message"]))
    if page.get("state") in ("ended", "failed"):
        record = world.record_of(user)
        assert record is not None
        return bool(page["again"]) or record.attempt >= MAX_ATTEMPTS
    return False
