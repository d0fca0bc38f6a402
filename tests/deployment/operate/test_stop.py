"""`hippodrome stop`: it stops every server, leaves nothing of it, and can be repeated."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.model import ids, server, warm_pool
from hippodrome.control.model.messages import KeepWarm, StartServer
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Reason, ServerState
from hippodrome.control.model.warm_pool import Pool
from hippodrome.control.ports import DnsRecord, RunningTask, TaskRequest
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.operate.stop import Stopper
from testing.servers import Servers
from testing.studies import study
from tests.deployment.installation import Installed, process

OTHER = msgspec.structs.replace(study(), id="other")


@pytest.fixture
def world(installed: Installed) -> Installed:
    definition = "hippodrome"
    installed.register(
        msgspec.structs.replace(study(), task_definition=definition),
        msgspec.structs.replace(OTHER, task_definition=definition),
    )
    return installed


def start(world: Installed, project: str, *users: str) -> None:
    """Start servers of these participants, with their timers and DNS names."""
    servers = Servers(world.platform)
    before = set(world.task_arns())
    for user in users:
        servers.start(StartServer(project, user))
    from hippodrome.control.model.messages import parse_task_changed

    events = [parse_task_changed(world.task_event(arn, "RUNNING")) for arn in world.task_arns() if arn not in before]
    assert servers.tasks_changed([event for event in events if event]) == []


def running_servers(world: Installed) -> list[str]:
    return [task.name for task in world.platform.tasks.list()]


def reasons(world: Installed, project: str, *users: str) -> set[Any]:
    repository = Repository(world.platform.documents)
    return {record.reason for user in users if (record := repository.server_of(project, user))}


def test_every_server_is_stopped_with_the_reason_stopped(world: Installed, capsys: Any) -> None:
    people = [f"p{n}" for n in range(30)]
    start(world, "maze", *people)
    start(world, "other", "x")
    ran = world.run(capsys, "stop", "--all", "--yes", "--json")
    assert (ran.code, ran.json["stopped"]) == (Exit.DONE, 31)
    assert (running_servers(world), world.records(), world.timers()) == ([], {}, {})
    assert reasons(world, "maze", *people) == {Reason.STOPPED}
    assert "Participants can start a server again" in ran.err
    assert not any(person in ran.out + ran.err for person in people)


def test_a_second_run_has_nothing_to_do(world: Installed, capsys: Any) -> None:
    start(world, "maze", "alice")
    assert world.run(capsys, "stop", "--all", "--yes").code == Exit.DONE
    with world.recording() as calls:
        ran = world.run(capsys, "stop", "--all")  # without a question
    assert ran.code == Exit.DONE
    assert "Nothing runs" in ran.err
    assert not [c for c in calls if not c.operation.startswith(("Get", "List", "Describe", "Head"))]


def test_stop_can_stop_the_servers_of_one_project(world: Installed, capsys: Any) -> None:
    start(world, "maze", "alice")
    start(world, "other", "alice")
    assert world.run(capsys, "stop", "--yes", "maze").code == Exit.DONE
    assert running_servers(world) == [ids.server_name(ids.server_label("other", "alice"), 1)]
    assert len(world.records()) == len(world.timers()) == 1


def test_a_dry_run_and_a_missing_answer_change_nothing(world: Installed, capsys: Any) -> None:
    start(world, "maze", "alice")
    with world.recording() as calls:
        dry = world.run(capsys, "stop", "--all", "--dry-run", "--json")
        asked = world.run(capsys, "stop", "--all")
    assert (dry.code, dry.json["found"]["servers"]) == (Exit.CHANGES, 1)
    assert asked.code == Exit.DECLINED
    assert not [c for c in calls if not c.operation.startswith(("Get", "List", "Describe", "Head"))]
    assert running_servers(world)


def test_leftovers_are_removed_but_not_what_may_belong_to_another_installation(world: Installed, capsys: Any) -> None:
    closed = ids.server_name(ids.server_label("maze", "alice"), 1)
    world.record("alice", ServerState.CLOSED, reason=Reason.ENDED)
    nobody = ids.server_name(ids.server_label("maze", "nobody"), 1)
    platform = world.platform
    for name in (closed, nobody):
        platform.tasks.run(TaskRequest(name, "hippodrome", "hippodrome", 1, 2, {}))
        platform.dns.change(add=[DnsRecord(f"{name}.servers.example.org", "203.0.113.9")])
        platform.timers.set(name, platform.now(), {})
    platform.dns.change(add=[DnsRecord("www.example.org", "203.0.113.1")])
    assert world.run(capsys, "stop", "--all", "--yes").code == Exit.DONE
    assert (running_servers(world), world.timers()) == ([], {})
    assert set(world.records()) == {f"{nobody}.servers.example.org", "www.example.org"}


def test_another_installations_server_in_a_cluster_of_its_own_is_left_alone(world: Installed, capsys: Any) -> None:
    theirs = ids.server_name(ids.server_label("their-study", "alice"), 1)
    tasks = world.platform.tasks
    tasks.create_cluster(theirs)
    tasks.run(TaskRequest(theirs, "hippodrome", theirs, 1, 2, {}))
    assert world.run(capsys, "stop", "--all", "--yes").code == Exit.DONE
    assert running_servers(world) == [theirs]
    assert [*tasks.clusters()] == [theirs]


def test_a_start_message_after_stop_starts_no_server(world: Installed, capsys: Any) -> None:
    world.record("alice", ServerState.STARTING)  # the record is written; there is neither timer nor task yet
    assert world.run(capsys, "stop", "--all", "--yes", "--json").json["stopped"] == 1
    Servers(world.platform).start(StartServer("maze", "alice"))
    assert running_servers(world) == []


WARM = study(task_definition="hippodrome", warm_servers=3)


def pool(world: Installed) -> Pool:
    return from_json(world.get(warm_pool.pool_key("maze")), Pool)


def test_warm_servers_are_stopped_too_and_stop_says_that_a_live_study_gets_new_ones(
    world: Installed, capsys: Any
) -> None:
    world.register(WARM)
    world.warm(WARM, 3)
    Servers(world.platform).start(StartServer("maze", "alice"))  # alice takes one of the warm servers
    dry = world.run(capsys, "stop", "--all", "--dry-run", "--json").json
    assert dry["found"]["servers"] == 3
    assert sorted(line["warm"] for line in dry["servers"]) == [False, True, True]
    assert sum(dry["found"].values()) == 3  # alice's server is no leftover
    ran = world.run(capsys, "stop", "--all", "--yes")
    assert ran.code == Exit.DONE
    assert "3 servers were stopped; nothing is left" in ran.err
    assert "maze will have warm ones again within five minutes; `register --no-live` closes it" in ran.err
    assert (running_servers(world), world.records(), world.timers(), dict(pool(world).warm_servers)) == ([], {}, {}, {})
    assert world.keys("maze/handovers/") == []
    assert reasons(world, "maze", "alice") == {Reason.STOPPED}


def test_a_taken_warm_server_belongs_to_the_project_of_its_participant(world: Installed, capsys: Any) -> None:
    world.register(WARM, msgspec.structs.replace(OTHER, task_definition="hippodrome"))
    (name,) = world.warm(WARM, 1)
    Servers(world.platform).start(StartServer("maze", "alice"))
    assert world.run(capsys, "stop", "--yes", "other").code == Exit.DONE
    assert running_servers(world) == [name]
    assert world.run(capsys, "stop", "--yes", "maze").code == Exit.DONE
    assert running_servers(world) == []


def test_a_closed_study_gets_no_warm_servers_again(world: Installed, capsys: Any) -> None:
    world.register(WARM)
    world.warm(WARM, 2)
    world.register(msgspec.structs.replace(WARM, live=False))
    assert "warm ones again" not in world.run(capsys, "stop", "--all", "--yes").err
    Servers(world.platform).start(KeepWarm("maze"))
    assert (running_servers(world), dict(pool(world).warm_servers)) == ([], {})


def test_servers_that_cannot_be_stopped_are_reported_and_the_others_are_stopped(world: Installed, capsys: Any) -> None:
    start(world, "maze", "alice", "bob")
    world.fail("ecs:StopTask", "AccessDeniedException", times=2)
    with_trouble = world.run(capsys, "stop", "--all", "--yes", "--wait", "0")
    assert with_trouble.code == Exit.FAILED
    assert "AccessDeniedException" in with_trouble.err
    assert world.run(capsys, "stop", "--all", "--yes").code == Exit.DONE
    assert (running_servers(world), world.timers()) == ([], {})


def test_stop_waits_until_tasks_have_ended(world: Installed, monkeypatch: Any) -> None:
    start(world, "maze", "alice")
    name = ids.server_name(ids.server_label("maze", "alice"), 1)
    saving = RunningTask("arn", "hippodrome", name)
    looks = iter([[saving], [saving], [saving], []])
    monkeypatch.setattr(EcsTasks, "draining", lambda self, *clusters: next(looks))
    slept: list[float] = []
    left = Stopper(world.platform, executor=Executor(slept.append)).run(wait=60)
    assert not left
    assert len(slept) == 2


def test_foreign_and_broken_records_are_not_changed(world: Installed, capsys: Any) -> None:
    world.put("_servers/readme.txt", b"hello")
    world.put(server.key(ids.server_label("maze", "broken")), b"{")
    stolen = world.record("alice")
    world.put(server.key(ids.server_label("maze", "bob")), world.get(server.key(stolen.label)))
    start(world, "maze", "carol")
    assert world.run(capsys, "stop", "--all", "--yes", "--json").json["stopped"] == 2
    assert world.get("_servers/readme.txt") == b"hello"


def test_an_unknown_project_and_a_missing_stack_are_reported_in_a_sentence(world: Installed, capsys: Any) -> None:
    ran = world.run(capsys, "stop", "labyrinth")
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "No project named labyrinth" in ran.err
    assert "maze, other" in ran.err
    assert "no stack named nowhere" in world.run(capsys, "stop", "--all", "--stack", "nowhere").err
    world.stack_status("ROLLBACK_COMPLETE")
    assert "ROLLBACK_COMPLETE" in world.run(capsys, "stop", "--all").err


def test_as_a_process(world: Installed) -> None:
    start(world, "maze", "alice")
    with world.served() as env:
        dry = process(env, "stop", "--all", "--dry-run", "--json")
        assert (dry.code, dry.json["found"]["servers"]) == (Exit.CHANGES, 1)
        assert process(env, "stop", "--all").code == Exit.DECLINED
        ran = process(env, "stop", "--all", "--yes", "--json")
    assert (ran.code, ran.json["stopped"]) == (Exit.DONE, 1)
    assert running_servers(world) == []
