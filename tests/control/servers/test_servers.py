"""What the functions behind the queues do with servers, on a platform in memory."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import pytest

from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.messages import DnsChanged, StartServer, StopServer, TaskChanged
from hippodrome.control.model.project import MASTER_LIST, MasterList
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState, may_go_without, requestable_attempt
from hippodrome.control.ports import NoCapacity, Refused, Topic
from hippodrome.control.servers.causes import Cause
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.storage.secret import SecretCache
from hippodrome.protocol import exits
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import installed, study

LABEL = ids.server_label("maze", "alice")
START = StartServer("maze", "alice")
STOP = StopServer("maze", "alice")


@pytest.fixture
def servers(platform: FakePlatform) -> Servers:
    return Servers(platform)


def token(platform: FakePlatform) -> str:
    """Return the token that the page gets."""
    return SecretCache(platform.documents).token(record(platform))


def record(platform: FakePlatform) -> Server:
    return from_json(platform.documents.kept[server.key(LABEL)][0], Server)


def event(platform: FakePlatform, status: str, attempt: int = 1, **changes: object) -> TaskChanged:
    name = ids.server_name(LABEL, attempt)
    task = next((t for (n, _), t in platform.tasks.by_name.items() if n == name), "arn:gone")
    given = {"interface": "eni-1", "stop_code": None, "stopped_reason": "", "exit_code": None, **changes}
    return TaskChanged(task=task, cluster="hippodrome", name=name, status=status, **given)  # type: ignore[arg-type]


def follow_up(platform: FakePlatform) -> DnsChanged:
    message = messages.parse_dns_changed(json.loads(json.dumps(platform.bus.delayed.pop(0)[1])))
    assert message
    return message


def nothing_left(platform: FakePlatform) -> bool:
    return not (platform.tasks.running or platform.dns.records or platform.timers.due or platform.tasks.own_clusters)


# Start


def test_a_start_schedules_the_shutdown_and_runs_one_task_on_spot(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    (request,) = platform.tasks.running.values()
    assert request.spot
    assert (request.cpu, request.memory, request.cluster) == (1, 2, "hippodrome")
    at, message = platform.timers.due[f"{LABEL}-1"]
    assert (at - platform.now()).total_seconds() == 30 * 60
    assert message == {"projectId": "maze", "userId": "alice", "attempt": 1, "reason": "deadline"}
    assert record(platform).state is ServerState.STARTING


def test_the_installations_max_runtime_limits_the_projects() -> None:
    platform = installed(study(max_runtime=600))
    Servers(platform).start(START)
    assert (record(platform).deadline - platform.now()).total_seconds() == 120 * 60


def test_repeated_start_messages_start_one_server(platform: FakePlatform, servers: Servers) -> None:
    for _ in range(3):
        servers.start(START)
    assert len(platform.tasks.by_name) == 1


def test_two_functions_with_the_same_message_start_one_server(platform: FakePlatform, servers: Servers) -> None:
    platform.documents.before_write.append(lambda: Servers(platform).start(START))
    servers.start(START)
    assert len(platform.tasks.running) == 1


def test_the_trial_gets_its_settings_and_the_address_for_its_documents(
    platform: FakePlatform, servers: Servers
) -> None:
    servers.start(START)
    (request,) = platform.tasks.running.values()
    env = request.environment
    assert (env["PROJECT_ID"], env["USER_ID"], env["GAME_STEPS"]) == ("maze", "alice", "3")
    assert env["TOKEN"] == token(platform)
    assert env["GROUP"] == str(ids.group("maze", "alice", 2))
    assert json.loads(env["TRIAL"]) == {"game": "ALE/MsPacman-v5"}


def test_without_spot_capacity_the_server_runs_on_demand(platform: FakePlatform, servers: Servers) -> None:
    platform.tasks.fail = [NoCapacity()]
    servers.start(START)
    (request,) = platform.tasks.running.values()
    assert not request.spot


def test_a_server_that_aws_refuses_is_closed_with_the_reason_and_leaves_nothing(
    platform: FakePlatform, servers: Servers
) -> None:
    platform.tasks.fail = [Refused("no such task definition")]
    servers.start(START)
    assert (record(platform).state, record(platform).reason) == (ServerState.CLOSED, Reason.REFUSED)
    assert nothing_left(platform)
    assert not platform.bus.sent


def test_a_start_that_crashed_before_run_task_is_finished_by_the_next_delivery(
    platform: FakePlatform, servers: Servers
) -> None:
    platform.tasks.fail = [ConnectionError()]
    with pytest.raises(ConnectionError):
        servers.start(START)
    before = token(platform)
    servers.start(START)
    (request,) = platform.tasks.running.values()
    assert request.environment["TOKEN"] == token(platform) == before


def test_a_start_for_a_closed_study_starts_nothing() -> None:
    platform = installed(study(live=False))
    Servers(platform).start(START)
    assert nothing_left(platform)


def test_a_server_that_is_stopped_while_it_starts_leaves_nothing(platform: FakePlatform, servers: Servers) -> None:
    run = platform.tasks.run

    def be_stopped_and_run(request: object) -> str:
        assert Servers(platform).stop([STOP]) == []
        return run(request)  # type: ignore[arg-type]

    platform.tasks.run = be_stopped_and_run  # type: ignore[method-assign]
    servers.start(START)
    assert record(platform).is_closed
    servers.tasks_changed([event(platform, "RUNNING")])
    assert nothing_left(platform)


def test_without_spot_a_repeated_start_does_not_try_spot_again(platform: FakePlatform, servers: Servers) -> None:
    platform.tasks.fail = [NoCapacity()]
    servers.start(START)
    servers.start(START)
    assert [request.spot for request in platform.tasks.running.values()] == [False]


def test_the_last_automatic_attempt_does_without_spot(platform: FakePlatform, servers: Servers) -> None:
    for attempt in (1, 2, 3):
        servers.start(StartServer("maze", "alice", attempt))
        (request,) = platform.tasks.running.values()
        assert request.spot is (attempt < 3)
        platform.tasks.running.clear()
        servers.tasks_changed([event(platform, "STOPPED", attempt, stop_code="SpotInterruption")])


def test_of_two_tasks_for_one_server_the_second_is_stopped(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    ((first, request),) = platform.tasks.running.items()
    platform.tasks.by_name.clear()
    twin = platform.tasks.run(replace(request, cluster="twin"))
    name = request.name
    for task in (first, twin):
        servers.tasks_changed([TaskChanged(task, "hippodrome", name, "RUNNING", "eni-1", None, "", None)])
    assert list(platform.tasks.running) == [first]
    assert record(platform).task == first


def test_of_two_tasks_for_one_server_the_end_of_the_second_changes_nothing(
    platform: FakePlatform, servers: Servers
) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "RUNNING")])
    before = record(platform)
    servers.tasks_changed([event(platform, "STOPPED", stop_code="SpotInterruption")._replace(task="arn:twin")])
    assert record(platform) == before
    assert platform.dns.records
    assert platform.timers.due


def test_a_start_message_after_the_stop_starts_nothing(platform: FakePlatform, servers: Servers) -> None:
    servers.stop([STOP])
    servers.start(START)
    assert nothing_left(platform)
    assert not platform.tasks.by_name


def test_a_participants_own_cluster_is_made_and_removed_with_the_server() -> None:
    platform = installed(study(cluster="participant"))
    servers = Servers(platform)
    servers.start(START)
    assert platform.tasks.own_clusters == {f"{LABEL}-1"}
    servers.stop([STOP])
    assert nothing_left(platform)


# Names


def test_a_running_server_is_named_and_then_ready_when_the_change_is_in_sync(
    platform: FakePlatform, servers: Servers
) -> None:
    platform.dns.slow = True
    servers.start(START)
    assert servers.tasks_changed([event(platform, "RUNNING")]) == []
    assert record(platform).state is ServerState.NAMING
    assert platform.dns.records == {f"{LABEL}-1.servers.example.org": record(platform).host}
    servers.dns_changed(follow_up(platform))
    assert record(platform).state is ServerState.NAMING
    platform.dns.settle()
    servers.dns_changed(follow_up(platform))
    assert record(platform).state is ServerState.READY


def test_a_batch_of_servers_is_named_with_one_change(platform: FakePlatform, servers: Servers) -> None:
    for user in ("alice", "bob", "carol"):
        servers.start(StartServer("maze", user))
    batch = [
        TaskChanged(task, "hippodrome", request.name, "RUNNING", f"eni-{n}", None, "", None)
        for n, (task, request) in enumerate(platform.tasks.running.items())
    ]
    servers.tasks_changed(batch)
    assert platform.dns.changes == 1
    assert len(platform.dns.records) == 3


def test_events_that_come_twice_or_late_change_nothing(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    running = event(platform, "RUNNING")
    servers.tasks_changed([running, running])
    servers.tasks_changed([running])
    ready = record(platform)
    assert ready.state is ServerState.READY
    servers.stop([STOP])
    servers.tasks_changed([running])
    assert record(platform).is_closed
    assert nothing_left(platform)


def test_a_server_without_an_address_is_checked_again_later(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    early = event(platform, "RUNNING", interface="eni-bare")
    assert servers.tasks_changed([early]) == []
    assert len(platform.bus.delayed) == 1


def test_a_name_that_was_made_while_the_server_was_stopped_is_removed(platform: FakePlatform, servers: Servers) -> None:
    platform.dns.slow = True
    servers.start(START)
    change = platform.dns.change

    def stopped_just_before(add: object = (), remove: object = ()) -> str:
        platform.dns.change = change  # type: ignore[method-assign]
        Servers(platform).stop([STOP])
        return change(add, remove)  # type: ignore[arg-type]

    platform.dns.change = stopped_just_before  # type: ignore[method-assign]
    servers.tasks_changed([event(platform, "RUNNING")])
    platform.dns.settle()
    while platform.bus.delayed:
        servers.dns_changed(follow_up(platform))
    assert nothing_left(platform)


def test_with_subdomain_userid_a_servers_name_is_the_participants_id() -> None:
    platform = installed(study(subdomain="userId"))
    servers = Servers(platform)
    servers.start(StartServer("maze", "Alice"))
    (task,) = platform.tasks.running
    servers.tasks_changed(
        [TaskChanged(task, "c", platform.tasks.running[task].name, "RUNNING", "eni-1", None, "", None)]
    )
    assert list(platform.dns.records) == ["alice.servers.example.org"]


@pytest.mark.parametrize("allowed", [True, False])
def test_an_id_becomes_a_name_only_on_the_servers_level_and_only_where_allowed(allowed: bool) -> None:
    platform = installed(study(subdomain="userId"))
    platform.settings = replace(platform.settings, user_id_names=allowed)
    servers = Servers(platform)
    for user in ("Study", "www"):
        servers.start(StartServer("maze", user))
    found = [from_json(kept[0], Server) for key, kept in platform.documents.kept.items() if key.startswith("_servers/")]
    names = {one.user_id: one.dns for one in found}
    expected = r"(study|www)\.servers\.example\.org" if allowed else r"s[a-z2-7]{20}-1\.servers\.example\.org"
    assert [name for name in names.values() if not re.fullmatch(expected, name)] == []


FRONT_END = ["https://play.example.org", "http://localhost:3000"]


@pytest.mark.parametrize(
    ("allowed", "project", "user", "told"),
    [
        (True, {"plain_clients": True, "front_end": FRONT_END}, "alice", " ".join(FRONT_END)),
        (True, {"plain_clients": True}, "alice", None),
        (True, {"front_end": FRONT_END}, "alice", None),
        (False, {"plain_clients": True, "front_end": FRONT_END}, "alice", None),
    ],
)
def test_a_server_accepts_front_ends_without_tokens_only_if_project_and_installation_allow_it(
    allowed: bool, project: dict[str, object], user: str, told: str | None
) -> None:
    platform = installed(study(subdomain="userId", **project))
    platform.settings = replace(platform.settings, plain_clients=allowed)
    Servers(platform).start(StartServer("maze", user))
    (request,) = platform.tasks.running.values()
    assert request.environment.get("PLAIN_ORIGINS") == told


def test_a_warm_server_accepts_no_front_end_without_a_token() -> None:
    platform = installed(study(warm_servers=1, plain_clients=True, front_end=FRONT_END))
    platform.settings = replace(platform.settings, plain_clients=True)
    Servers(platform).start(StartServer("maze", ids.warm_id("maze", platform.now(), 1)))
    (request,) = platform.tasks.running.values()
    assert request.environment["WARM_SERVER"] == "on"
    assert "PLAIN_ORIGINS" not in request.environment


# Stop


def test_a_stop_leaves_nothing_and_may_be_repeated(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "RUNNING")])
    for _ in range(3):
        assert servers.stop([STOP]) == []
        assert nothing_left(platform)
    assert record(platform).reason is Reason.STOPPED


def test_a_late_deadline_of_an_earlier_attempt_does_not_stop_the_next(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "STOPPED", stop_code="SpotInterruption")])
    servers.start(StartServer("maze", "alice", 2))
    servers.stop([StopServer("maze", "alice", 1, "deadline")])
    assert record(platform).attempt == 2
    assert not record(platform).is_closed


def test_a_stop_finds_a_task_that_was_started_and_not_recorded(platform: FakePlatform, servers: Servers) -> None:
    run = platform.tasks.run

    def run_and_crash(request: object) -> str:
        run(request)  # type: ignore[arg-type]
        raise ConnectionError

    platform.tasks.run = run_and_crash  # type: ignore[method-assign]
    with pytest.raises(ConnectionError):
        servers.start(START)
    assert record(platform).task is None
    servers.stop([STOP])
    assert nothing_left(platform)


def test_two_copies_of_a_stop_are_one_stop(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    assert servers.stop([STOP, STOP]) == []
    assert nothing_left(platform)


def test_two_stops_at_the_same_moment_are_both_done(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    platform.documents.before_write.append(lambda: Servers(platform).stop([STOP]))
    assert servers.stop([STOP]) == []
    assert nothing_left(platform)


def test_a_server_that_cannot_be_stopped_does_not_prevent_the_others(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.start(StartServer("maze", "bob"))
    stop = platform.tasks.stop

    def fails_for_alice(task: str, cluster: str, reason: str) -> None:
        if platform.tasks.running[task].name.startswith(LABEL):
            raise ConnectionError
        stop(task, cluster, reason)

    platform.tasks.stop = fails_for_alice  # type: ignore[method-assign]
    assert servers.stop([STOP, StopServer("maze", "bob")]) == [STOP]
    assert len(platform.tasks.running) == 1


# Servers that end without a stop message


def test_a_trial_that_ended_by_itself_is_cleaned_up_and_not_replaced(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "RUNNING")])
    platform.tasks.running.clear()
    servers.tasks_changed([event(platform, "STOPPED", stop_code="EssentialContainerExited", exit_code=0)])
    assert record(platform).reason is Reason.ENDED
    assert nothing_left(platform)
    assert not platform.bus.sent


@pytest.mark.parametrize(
    ("code", "exit_code"),
    [
        ("SpotInterruption", None),
        ("TerminationNotice", None),
        ("TaskFailedToStart", None),
    ],
)
def test_a_lost_server_is_replaced_up_to_three_times(
    platform: FakePlatform, servers: Servers, code: str, exit_code: int | None
) -> None:
    for attempt in (1, 2, 3):
        servers.start(StartServer("maze", "alice", attempt))
        assert record(platform).attempt == attempt
        platform.tasks.running.clear()
        servers.tasks_changed([event(platform, "STOPPED", attempt, stop_code=code, exit_code=exit_code)])
        assert nothing_left(platform)
    wanted = [m["attempt"] for topic, m in platform.bus.sent if topic is Topic.START]
    assert wanted == [2, 3]
    assert requestable_attempt(record(platform)) is not None


@pytest.mark.parametrize("exit_code", [1, exits.NO_AGENT, exits.LATE_AGENT, exits.NO_PORT])
def test_a_server_on_which_the_game_cannot_begin_is_replaced_once(
    platform: FakePlatform, servers: Servers, exit_code: int
) -> None:
    """The next server would fail in the same way, and the participant would wait for it."""
    for attempt in (1, 2):
        servers.start(StartServer("maze", "alice", attempt))
        platform.tasks.running.clear()
        stopped = event(platform, "STOPPED", attempt, stop_code="EssentialContainerExited", exit_code=exit_code)
        servers.tasks_changed([stopped])
        assert nothing_left(platform)
    assert [m["attempt"] for topic, m in platform.bus.sent if topic is Topic.START] == [2]
    assert may_go_without(record(platform))
    assert requestable_attempt(record(platform)) == 3


def test_a_replacement_has_its_own_token(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    first = token(platform)
    servers.tasks_changed([event(platform, "STOPPED", stop_code="SpotInterruption")])
    servers.start(StartServer("maze", "alice", 2))
    assert token(platform) != first


def test_a_lost_message_for_a_replacement_is_sent_again(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    publish = platform.bus.publish
    platform.bus.publish = None  # type: ignore[assignment,method-assign] # the function dies right here
    stopped = event(platform, "STOPPED", stop_code="SpotInterruption")
    assert servers.tasks_changed([stopped]) == [stopped]
    platform.bus.publish = publish  # type: ignore[method-assign]
    assert servers.tasks_changed([stopped]) == []
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2})]


# Two events tell the end of a task


def test_a_server_taken_by_spot_is_replaced_as_soon_as_its_container_has_ended(
    platform: FakePlatform, servers: Servers
) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "RUNNING")])
    servers.tasks_changed([event(platform, "DEPROVISIONING", stop_code="SpotInterruption")])
    assert (record(platform).reason, record(platform).cause) == (Reason.LOST, Cause.SPOT)
    assert not platform.dns.records
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2})]


@pytest.mark.parametrize("late", ["RUNNING", "DEPROVISIONING", "STOPPED"])
def test_a_late_event_of_a_replaced_server_does_not_change_its_successor(
    platform: FakePlatform, servers: Servers, late: str
) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "DEPROVISIONING", stop_code="SpotInterruption")])
    servers.start(StartServer("maze", "alice", 2))
    before = record(platform)
    assert servers.tasks_changed([event(platform, late, stop_code="SpotInterruption")]) == []
    assert record(platform) == before
    assert len(platform.bus.sent) == 1


def test_a_server_that_never_ran_is_replaced_at_the_first_event_that_says_so(
    platform: FakePlatform, servers: Servers
) -> None:
    servers.start(START)
    told = event(platform, "DEPROVISIONING", stop_code="TaskFailedToStart")
    servers.tasks_changed([told._replace(stopped_reason="CannotPullContainerError: not found")])
    assert record(platform).cause == Cause.IMAGE
    assert [message["attempt"] for _, message in platform.bus.sent] == [2]


def test_a_trial_that_ended_by_itself_is_closed_at_its_first_event(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "DEPROVISIONING", stop_code="EssentialContainerExited", exit_code=0)])
    assert (record(platform).reason, record(platform).cause) == (Reason.ENDED, "")
    assert not platform.bus.sent


def own(platform: FakePlatform, status: str, code: str = "SpotInterruption") -> TaskChanged:
    """Return an event of a task in a cluster of its participant's own. Only STOPPED takes it out of there."""
    told = event(platform, status, stop_code=code)
    if status == "STOPPED":
        platform.tasks.running.pop(told.task, None)
    return told._replace(cluster=told.name)


@pytest.mark.parametrize("replaced", [False, True])
def test_a_cluster_that_still_has_its_task_delays_no_replacement_and_is_removed_at_the_last_event(
    replaced: bool,
) -> None:
    platform = installed(study(cluster="participant"))
    servers = Servers(platform)
    servers.start(START)
    assert servers.tasks_changed([own(platform, "DEPROVISIONING")]) == []
    assert [message["attempt"] for _, message in platform.bus.sent] == [2]
    assert platform.tasks.own_clusters == {f"{LABEL}-1"}
    if replaced:
        servers.start(StartServer("maze", "alice", 2))
    assert servers.tasks_changed([own(platform, "STOPPED")]) == []
    assert platform.tasks.own_clusters == ({f"{LABEL}-2"} if replaced else set())


def test_the_sweep_removes_a_cluster_whose_last_event_was_lost() -> None:
    platform = installed(study(cluster="participant"))
    servers = Servers(platform)
    servers.start(START)
    servers.tasks_changed([own(platform, "DEPROVISIONING", "EssentialContainerExited")._replace(exit_code=0)])
    own(platform, "STOPPED")  # the event is not delivered
    Sweep(platform).run()
    assert nothing_left(platform)


# Causes


@pytest.mark.parametrize(("state", "cause"), [("starting", Cause.ENDED_AT_ONCE), ("ready", Cause.CRASHED)])
def test_the_cause_depends_on_whether_the_server_was_ready(
    platform: FakePlatform, servers: Servers, state: str, cause: Cause
) -> None:
    servers.start(START)
    if state == "ready":
        servers.tasks_changed([event(platform, "RUNNING")])
    servers.tasks_changed([event(platform, "STOPPED", stop_code="EssentialContainerExited", exit_code=1)])
    assert record(platform).cause == cause
    assert servers.failures() == [cause]
    assert servers.failures() == []


def test_the_record_keeps_the_causes_of_earlier_attempts(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "STOPPED", stop_code="SpotInterruption")])
    servers.start(StartServer("maze", "alice", 2))
    assert record(platform).cause == ""
    assert [run.cause for run in record(platform).earlier] == [Cause.SPOT]


@pytest.mark.parametrize(
    ("error", "cause"),
    [(Refused("ClientException: TaskDefinition not found."), Cause.DEFINITION), (NoCapacity("full"), Cause.CAPACITY)],
)
def test_the_record_holds_the_cause_of_a_refusal_by_aws(
    platform: FakePlatform, servers: Servers, error: Exception, cause: Cause
) -> None:
    platform.tasks.fail = [error, error]
    servers.start(START)
    assert record(platform).cause == cause
    assert servers.failures() == [cause]


def test_a_server_that_was_stopped_has_not_failed(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.stop([STOP])
    assert record(platform).cause == ""
    assert servers.failures() == []


def test_events_of_another_installations_tasks_change_nothing(platform: FakePlatform, servers: Servers) -> None:
    name = ids.server_name(ids.server_label("other", "bob"), 1)
    servers.tasks_changed([TaskChanged("arn:x", "c", name, s, "eni-1", None, "", None) for s in ("RUNNING", "STOPPED")])
    assert platform.dns.changes == 0
    assert not platform.tasks.stopped


def test_the_event_for_a_record_that_keeps_changing_goes_back_to_the_queue(
    platform: FakePlatform, servers: Servers
) -> None:
    servers.start(START)
    key = server.key(LABEL)

    def touch() -> None:
        platform.documents.keep(key, platform.documents.kept[key][0])

    platform.documents.before_write = [touch] * 50
    running = event(platform, "RUNNING")
    assert servers.tasks_changed([running]) == [running]
    platform.documents.before_write = []
    servers.tasks_changed([event(platform, "RUNNING")])
    assert record(platform).state is ServerState.READY


def test_servers_of_a_closed_project_can_still_be_stopped(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    platform.documents.put(MASTER_LIST, to_json(MasterList([study(live=False)])))
    platform.wait(seconds=60)
    servers.stop([STOP])
    assert nothing_left(platform)


def test_a_crashed_start_is_ended_if_the_study_was_closed_meanwhile(platform: FakePlatform, servers: Servers) -> None:
    platform.tasks.fail = [ConnectionError()]
    with pytest.raises(ConnectionError):
        servers.start(START)
    platform.documents.put(MASTER_LIST, to_json(MasterList([study(live=False)])))
    platform.wait(seconds=60)
    servers.start(START)
    ((topic, message),) = platform.bus.sent
    stop = messages.parse_stop_server(message)
    assert (topic, stop) == (Topic.STOP, StopServer("maze", "alice", 1))
    servers.stop([STOP])
    assert record(platform).reason is Reason.STOPPED
    assert nothing_left(platform)


# Earlier attempts, for the costs


def test_the_record_keeps_the_earlier_attempts_with_times_and_sizes(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "RUNNING")])
    platform.wait(minutes=5)
    servers.stop([STOP])
    first = record(platform)
    assert (first.cpu, first.memory, first.earlier) == (1, 2, ())
    servers.start(StartServer("maze", "alice", 2))
    second = record(platform)
    assert (second.attempt, second.state) == (2, ServerState.STARTING)
    (run,) = second.earlier
    assert (run.attempt, run.cpu, run.memory, run.spot, run.reason) == (1, 1, 2, True, Reason.STOPPED)
    assert (run.requested, run.running, run.closed) == (first.requested, first.running, first.closed)
    servers.stop([STOP])
    servers.start(StartServer("maze", "alice", 3))
    assert [run.attempt for run in record(platform).earlier] == [1, 2]


# Messages that come again


def test_a_repeated_start_message_stops_no_game_of_a_closed_study(platform: FakePlatform, servers: Servers) -> None:
    servers.start(START)
    servers.tasks_changed([event(platform, "RUNNING")])
    assert record(platform).state is ServerState.READY
    platform.bus.sent.clear()
    platform.documents.put(MASTER_LIST, to_json(MasterList([study(live=False)])))
    platform.wait(seconds=11)
    servers.start(START)
    assert platform.bus.sent == []
    assert len(platform.tasks.running) == 1


def test_a_server_that_was_stopped_while_spot_was_asked_does_not_start_on_demand(
    platform: FakePlatform, servers: Servers
) -> None:
    run = platform.tasks.run

    def stopped_meanwhile(request: object) -> str:
        platform.tasks.run = run  # type: ignore[method-assign]
        servers.stop([STOP])
        raise NoCapacity

    platform.tasks.run = stopped_meanwhile  # type: ignore[method-assign, assignment]
    servers.start(START)
    assert record(platform).is_closed
    assert nothing_left(platform)
