"""The parts of a rehearsal without bots: a server's timer, the sweep, an alarm, the times of AWS, and the cost."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from hippodrome.control.model import ids
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import DnsRecord, Topic
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.cost.prices import REGION, Range, server_hour
from hippodrome.deployment.cost.spent import spent
from hippodrome.deployment.operate import snapshot
from hippodrome.deployment.operate.doctor.check_context import CheckFailed
from hippodrome.deployment.operate.doctor.play.scene import RehearsalContext
from hippodrome.deployment.operate.doctor.play.simulated import STAGES
from hippodrome.deployment.operate.doctor.play.transcript import shown
from hippodrome.deployment.operate.doctor.play.walk import left
from hippodrome.deployment.operate.doctor.rehearsal import write_session
from hippodrome.protocol.session import Member, SessionDocument

READY = 420.0  # seconds until a server must be ready, a lost attempt included
SOON = timedelta(seconds=75)  # the time from now until the moved timer; a timer fires within the minute after its time
FIRED = 330.0  # seconds until the timer's server must be closed
TASK_GONE = 240.0  # seconds until its task, timer and name must be gone
SEEN = 30.0  # seconds until AWS's lists must show what was made or removed
ACTED = 60.0  # seconds until CloudWatch must have sent to the topic
NOWHERE = "192.0.2.1"  # an address for documentation (RFC 5737), which no host has
REASON = "Rehearsal: set by hand to see whether this alarm is delivered. Nothing is wrong."


class Timer:
    """Tests a server's timer: `begin` starts a server without a participant, `end` checks that its timer has ended it.

    The rehearsal does not wait for the project's `maxRuntime`. It checks that the ready server has a timer at its
    deadline, and moves the timer to the next minute, with the same name, role, topic and message.
    """

    def __init__(self, scene: RehearsalContext) -> None:
        self._scene = scene
        bot = scene.copy.user("timer")
        self.user = ids.new_session_id() if scene.copy.project.players > 1 else bot
        scene.transcript.hide(bot, self.user)
        self._bot = bot
        self.record: Server | None = None

    def begin(self) -> None:
        """Request the server, by a start message for a participant who never comes."""
        if self.user != self._bot:
            copy = self._scene.copy
            copy.users.append(self.user)
            session = SessionDocument(self.user, copy.project.players, (Member(self._bot, None, 0),))
            write_session(self._scene.platform.documents, copy.id, session)
        self._scene.platform.bus.publish(Topic.START, to_message(StartServer(self._scene.copy.id, self.user)))

    def end(self) -> None:
        """Move the timer, and wait until it has ended the server. Raises `CheckFailed` if it does not."""
        scene, platform = self._scene, self._scene.platform
        record = scene.wait(
            self._ready,
            "waiting for the server that its timer is to end",
            READY,
            CheckFailed("Its server was not ready in time.", "See `hippodrome logs --all --function start_server`."),
        )
        self.record = record
        if self._set_for(record) != record.deadline.astimezone(UTC).replace(microsecond=0):
            raise CheckFailed(
                "It has no timer at its deadline.", "See `hippodrome logs --all --function start_server`."
            )
        at = platform.now() + SOON
        platform.timers.set(
            record.name, at, to_message(StopServer(scene.copy.id, self.user, record.attempt, Reason.DEADLINE))
        )
        closed = scene.wait(
            self._closed,
            "waiting for the timer to fire",
            FIRED,
            CheckFailed(
                "Its timer has not fired.",
                "See `hippodrome logs --all --function stop_server`, and the schedule's role.",
            ),
        )
        if closed.reason is not Reason.DEADLINE:
            raise CheckFailed(f"It ended before its timer fired: {closed.reason}.", "See `hippodrome status --all`.")
        late = ((closed.closed or at) - at).total_seconds()
        scene.wait(
            lambda: None if left(scene, self.user) else True,
            "waiting until its task is gone",
            TASK_GONE,
            CheckFailed("Its timer fired, and something of the server is left.", "Run `hippodrome stop --all`."),
        )
        self.record = closed
        text = f"It stood at the deadline; moved nearer, it ended the server {late:.0f} s after its time."
        scene.transcript.good("timer", text, after=round(late, 1))

    def _ready(self) -> Server | None:
        record = self._scene.server(self.user)
        return record if record and record.state is ServerState.READY else None

    def _closed(self) -> Server | None:
        record = self._scene.server(self.user)
        return record if record and record.is_closed else None

    def _set_for(self, record: Server) -> datetime | None:
        context = self._scene.context
        scheduler, group = context.account.client("scheduler"), context.installation["ScheduleGroup"]
        try:
            schedule_expression = scheduler.get_schedule(GroupName=group, Name=record.name)["ScheduleExpression"]
        except scheduler.exceptions.ResourceNotFoundException:
            return None
        return datetime.strptime(schedule_expression, "at(%Y-%m-%dT%H:%M:%S)").replace(tzinfo=UTC)


def sweep(scene: RehearsalContext, closed: Server | None) -> None:
    """Make a timer and a name for a closed server, and run the sweep. Raises `CheckFailed` if it leaves one of them.

    Without a domain servers have no names.
    """
    if closed is None or not closed.is_closed:
        raise CheckFailed("There is no closed server to leave something behind.", "See the line `timer`.")
    platform = scene.platform
    later = platform.now() + timedelta(days=1)
    stop = StopServer(closed.project_id, closed.user_id, closed.attempt, Reason.DEADLINE)
    platform.timers.set(closed.name, later, to_message(stop))
    leftovers = ["a timer"]
    if closed.dns:
        platform.dns.change(add=[DnsRecord(closed.dns, NOWHERE)])
        leftovers.append("a name")
    scene.wait(
        lambda: True if len(left(scene, closed.user_id)) == len(leftovers) else None,
        "waiting until the leftovers can be seen",
        SEEN,
        CheckFailed(f"{' and '.join(leftovers).capitalize()} were made, and AWS does not list them.", "Run it again."),
    )
    scene.progress("running the sweep")
    answer = scene.context.account.client("lambda").invoke(
        FunctionName=resource_names.function(scene.context.installation.stack, "sweep"), Payload=b"{}"
    )
    payload = answer["Payload"].read()
    if answer.get("FunctionError"):
        kind = _type_of(payload)
        raise CheckFailed(f"The sweep failed{kind}.", "See `hippodrome logs --all --function sweep --errors`.")
    scene.wait(
        lambda: None if left(scene, closed.user_id) else True,
        "waiting until the leftovers are gone",
        SEEN,
        CheckFailed(
            "The sweep has left something of a closed server.", "See `hippodrome logs --all --function sweep`."
        ),
    )
    scene.transcript.good("sweep", f"It removed {' and '.join(leftovers)} that a closed server had left.")


def _type_of(body: bytes) -> str:
    try:
        return f": {json.loads(body)['errorType']}"
    except (ValueError, KeyError, TypeError):
        return ""


def alarm(scene: RehearsalContext) -> None:
    """Set an alarm to ALARM by hand, and set it back. Raises `CheckFailed` if its topic got no message.

    CloudWatch sets an alarm back to its actual state by itself, often within seconds; its actions are in the alarm's
    history (CloudWatch API Reference, SetAlarmState). Whether a mail arrives, only the mailbox's owner can see.
    """
    context = scene.context
    cloudwatch, topic = context.account.client("cloudwatch"), context.installation["Alarms"]
    quiet = [
        alarm
        for alarm in snapshot.alarms(context.account, context.installation)
        if alarm.get("StateValue") != "ALARM"
        and topic in alarm.get("AlarmActions", ())
        and alarm.get("ActionsEnabled", True)
    ]
    if not quiet:
        raise CheckFailed("There is no alarm that is quiet and tells its topic.", "Run `hippodrome apply`.")
    chosen = min(quiet, key=lambda candidate: str(candidate["AlarmName"]))
    name, before, began = chosen["AlarmName"], chosen.get("StateValue", "OK"), datetime.now(UTC) - timedelta(seconds=5)
    cloudwatch.set_alarm_state(AlarmName=name, StateValue="ALARM", StateReason=REASON)
    try:
        scene.wait(
            lambda: True if _sent_to_topic(cloudwatch, name, began) else None,
            "waiting until the alarm has reached its topic",
            ACTED,
            CheckFailed(
                "The alarm was set off, and its topic was not told.", "See the alarm's history in CloudWatch's console."
            ),
        )
    finally:
        now = cloudwatch.describe_alarms(AlarmNames=[name])["MetricAlarms"]
        if now and now[0].get("StateValue") == "ALARM":
            cloudwatch.set_alarm_state(AlarmName=name, StateValue=before, StateReason=REASON)
    listed = snapshot.subscriptions(context.account, context.installation)
    subscribers = sum(listing["SubscriptionArn"].startswith("arn:") for listing in listed)  # confirmed subscriptions
    if subscribers:
        scene.transcript.good(
            "alarm",
            "An alarm was set off and reached its topic: a mail is on its way to "
            f"{subscribers} {'address' if subscribers == 1 else 'addresses'}.",
        )
    else:
        scene.transcript.say(
            "alarm",
            Mark.LOOK,
            "An alarm was set off and reached its topic, which has no subscriber.",
            "Give `hippodrome apply` an --email, and follow the link in AWS's e-mail.",
        )


def _sent_to_topic(cloudwatch: Any, name: str, since: datetime) -> bool:
    alarm_history = cloudwatch.describe_alarm_history(AlarmName=name, HistoryItemType="Action", StartDate=since)
    return any(
        "success" in alarm_history_item.get("HistorySummary", "").lower()
        for alarm_history_item in alarm_history["AlarmHistoryItems"]
    )


def times(scene: RehearsalContext, records: Iterable[Server]) -> None:
    """Add the line on how long AWS took for each stage, beside the simulation's times.

    Raises `CheckFailed` if no server ran.
    """
    tasks = _tasks(scene, records)
    measured: dict[str, list[float]] = {stage: [] for stage in STAGES}
    for record in records:
        task = tasks.get(record.task or "", {})
        started = task.get("startedAt")
        _add_seconds(measured["start"], task.get("createdAt"), started)
        _add_seconds(measured["told"], started, record.running)
        _add_seconds(measured["name" if record.dns else "certificate"], record.running, record.ready)
        _add_seconds(measured["gone"], task.get("executionStoppedAt"), task.get("stoppedAt"))
    texts, slow = [], []
    for stage, seconds in measured.items():
        assumed = STAGES[stage]
        usual = f"{assumed.usual[0]:.0f} to {assumed.usual[1]:.0f} s, at most {assumed.most:.0f} s"
        if seconds:
            texts.append(f"{assumed.what}: {shown(seconds)} (simulated: {usual})")
            slow += [stage] if max(seconds) > assumed.most else []
    if not texts:
        raise CheckFailed("No server ran, so nothing was measured.", "See the line `servers`.")
    rounded = {stage: [round(duration, 1) for duration in seconds] for stage, seconds in measured.items()}
    mark = Mark.LOOK if slow else Mark.GOOD
    advice = f"Slower than the simulation assumes: {', '.join(slow)}. Its figures are too hopeful here." if slow else ""
    scene.transcript.say("times", mark, "; ".join(texts) + ".", advice, **rounded)


def _tasks(scene: RehearsalContext, records: Iterable[Server]) -> dict[str, Mapping[str, Any]]:
    """Return, by ARN, the servers' tasks from DescribeTasks, which knows a stopped task for about an hour."""
    ecs = scene.context.account.client("ecs")
    tasks: dict[str, Mapping[str, Any]] = {}
    for record in records:
        if record.task and record.cluster:
            answer = ecs.describe_tasks(cluster=record.cluster, tasks=[record.task])
            tasks |= {task["taskArn"]: task for task in answer["tasks"]}
    return tasks


def _add_seconds(seconds: list[float], begin: datetime | None, end: datetime | None) -> None:
    if begin and end:
        seconds.append(max((end - begin).total_seconds(), 0.0))


def estimate(project: Project, bots: int) -> Range:
    """Estimate what a rehearsal costs: servers run for 2 to 20 minutes each. All else costs less than a cent."""
    servers = bots + 3  # the killed server, its replacement, and the server that its timer ends
    size = project.size
    spot, on_demand = (server_hour(size.cpu, size.memory, spot=kind) for kind in (True, False))
    return Range(spot.low * servers * 2 / 60, spot.likely * servers * 4 / 60, on_demand.high * servers * 20 / 60)


def cost(scene: RehearsalContext, records: Iterable[Server]) -> None:
    """Add the line on what the servers have cost, by their records."""
    total = spent(records, datetime.now(UTC))
    minutes = total.hours * 60
    text = f"About ${total.usd.likely:.4f} for {total.attempts} servers with {minutes:.0f} minutes together"
    scene.transcript.good("cost", f"{text}, by list prices of {REGION}; the rest is less than a cent.")
