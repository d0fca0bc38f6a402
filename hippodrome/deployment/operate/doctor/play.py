"""`doctor --rehearse --play`: bots play a copy of a study on a real account, which proves what no emulator can.

The parts run one after the other. If one fails, the transcript gets a line with advice, and the next part runs. In any
case, also after Ctrl-C, the copy is removed with all documents and servers of the bots.
"""

from __future__ import annotations

import asyncio
import json
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from random import Random

from hippodrome.bots.addresses import OneSite
from hippodrome.bots.bot import Bot
from hippodrome.bots.crowd import interruptible, walk
from hippodrome.bots.http import Reply, ask
from hippodrome.bots.report import BotReport
from hippodrome.bots.verification import verify
from hippodrome.console.formatting import count
from hippodrome.control.model.messages import StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import DnsRecord, Topic
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.cost.prices import REGION, Range, server_hour
from hippodrome.deployment.cost.spent import spent
from hippodrome.deployment.operate import snapshot
from hippodrome.deployment.operate.doctor import addresses
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.operate.doctor.rehearsal import CheckFailed, LoneServer, Progress, left_of
from hippodrome.deployment.operate.doctor.study_copy import StudyCopy, left_behind
from hippodrome.deployment.operate.doctor.transcript import Transcript
from hippodrome.export import run as data
from hippodrome.export.bucket import Bucket

PLAY = 8.0  # seconds that a bot plays
VICTIM_PLAYS = 25.0  # seconds that the victim, whose task is killed, plays: its game must still run then
STRUCK = 2.0  # seconds of play after which its task is killed
ARRIVALS = 1.0  # seconds between the arrivals of two bots
BOT_PATIENCE = 420.0  # seconds that a bot waits for one event: the longest time of three attempts of a server
PAUSE = 2.0  # seconds between two looks
GONE = 240.0  # seconds until nothing of a server may be left: stopTimeout is 120
SOON = timedelta(seconds=75)  # the time from now until the moved timer; a timer fires within the minute after its time
FIRED = 330.0  # seconds until the timer's server must be closed
SEEN = 30.0  # seconds until AWS's lists must show what was made or removed
ACTED = 60.0  # seconds until CloudWatch must have sent to the topic
NOWHERE = "192.0.2.1"  # an address for documentation (RFC 5737), which no host has
ALARM_TEXT = "Rehearsal: set by hand to see whether this alarm is delivered. Nothing is wrong."
KILLED = "Rehearsal: killed, as when a Spot task is interrupted"
"""The reason that StopTask gets. ECS puts it into the task's `stoppedReason` (ECS API Reference, StopTask). It counts
as a Spot interruption in `hippodrome/control/model/messages.py`, whatever the stop code: the server is lost."""

LOGS = "See `hippodrome logs --all --errors`."


def estimate(project: Project, bots: int) -> Range:
    """Estimate what a rehearsal costs: servers run for 2 to 20 minutes each. All else costs less than a cent."""
    servers = bots + 3  # the killed server, its replacement, and the server that its timer ends
    size = project.size
    spot, on_demand = (server_hour(size.cpu, size.memory, spot=kind) for kind in (True, False))
    return Range(spot.low * servers * 2 / 60, spot.likely * servers * 4 / 60, on_demand.high * servers * 20 / 60)


def site(context: CheckContext, project_id: str) -> OneSite:
    """Return the addresses that bots may open: the addresses of the installation's site and of its servers."""
    servers = context.platform.settings.game_sources.split()
    return OneSite(context.installation["Site"], servers, project_id, tls=addresses.authorities())


class Play:
    """A rehearsal with bots. Each part returns its line, or raises `CheckFailed`; `transcript` collects them."""

    def __init__(
        self,
        context: CheckContext,
        project: Project,
        transcript: Transcript,
        progress: Progress,
        *,
        bots: int,
        minutes: int,
    ) -> None:
        self._context = context
        self._platform = context.platform
        self._project = project
        self._progress = progress
        self._transcript = transcript
        self._until = time.monotonic() + minutes * 60
        self._copy = StudyCopy(context)
        self._allowed = site(context, self._copy.id)
        bots += -(bots + 1) % project.players  # bots and victim together fill whole sessions
        self._names = [*map(str, range(1, bots + 1)), "victim"]
        self.bots: list[Bot] = []  # the last is the victim, whose task is killed
        self._struck = False
        self._not_struck = "its game never began"
        installation = context.installation
        transcript.hide(*(installation[name] for name in ("Bucket", "HostedZoneId", "RootDomain")))

    def run(self) -> None:
        """Run all parts, then remove everything. After Ctrl-C, remove everything and raise KeyboardInterrupt."""
        part = self._transcript.part
        part("erased", self._remove_old_copies)
        try:
            if part("study", self._make):
                lone = LoneServer(self._platform, self._copy.project, self._progress)
                begun = part("timer", lone.start)
                part("site", self._site)
                part("links", self._links)
                part("pages", self._walk)
                part("servers", self._servers)
                part("game", self._games)
                part("killed", self._killed)
                part("end", self._end)
                part("data", self._data)
                if begun:
                    part("timer", lambda: self._timer(lone))
                part("sweep", lambda: self._sweep(lone.record))
                part("alarm", self._alarm)
        finally:
            part("erased", self._remove)

    # The copy

    def _remove_old_copies(self) -> None:
        for copy_id in left_behind(self._context, datetime.now(UTC)):
            self._progress("removing what an earlier rehearsal has left")
            StudyCopy(self._context, copy_id).remove(self._progress)

    def _make(self) -> str:
        self._progress("registering a copy of the study")
        pages = self._copy.make(self._project)
        patience = min(BOT_PATIENCE, self._left())
        for name in self._names:
            user = self._copy.user(name)
            play = VICTIM_PLAYS if name == "victim" else PLAY
            random = Random(user)  # noqa: S311 - for the keys that it presses
            link = self._copy.link(user)
            self.bots.append(Bot(link, user, random, play=play, patience=patience, allowed=self._allowed))
        return f"A copy of a registered study, with {pages} pages of its own, was registered."

    def _remove(self) -> str:
        deleted, servers = self._copy.remove(self._progress)
        total = spent(servers, datetime.now(UTC))
        about = (
            f"About ${total.usd.likely:.4f} for {total.attempts} servers with {total.hours * 60:.0f} minutes together"
        )
        text = f"{about}, by list prices of {REGION}; the rest is less than a cent."
        self._transcript.say("cost", Mark.GOOD, text)
        return f"The copy and the bots' data are gone, {deleted} versions of documents in all."

    # Looking

    def _left(self) -> float:
        """The seconds until the rehearsal must end."""
        return max(self._until - time.monotonic(), 0.0)

    def _wait(self, missing: Callable[[], str], activity: str, seconds: float, text: str, advice: str) -> None:
        """Wait until nothing is `missing`. Raises `CheckFailed` with `text` and what is missing after `seconds`."""
        began = time.monotonic()
        while what := missing():
            passed = time.monotonic() - began
            if passed > seconds or not self._left():
                raise CheckFailed(f"{text}: {what}.", advice)
            self._progress(f"{activity}: {what}, {passed:.0f} s")
            time.sleep(PAUSE)

    def _until_gone(self, records: Iterable[Server], seconds: float, text: str, advice: str) -> None:
        users = [record.user_id for record in records]
        self._wait(lambda: self._left_of(users), "waiting until nothing is left", seconds, text, advice)

    def _record(self, bot: Bot) -> Server | None:
        """Read the record of a bot's server, or of its session's server."""
        repository, user = Repository(self._platform.documents), bot.report.user_id
        return repository.server_of(self._copy.id, repository.session_id(self._copy.project, user) or user)

    def _records(self) -> list[Server]:
        """Read the records of all bots' servers, each once: the members of a session have the same server."""
        return list({record.label: record for record in map(self._record, self.bots) if record}.values())

    def _left_of(self, users: Iterable[str]) -> str:
        """Say what is left of the servers of these users and sessions."""
        read = Repository(self._platform.documents).server_of
        records = [record for user in users if (record := read(self._copy.id, user))]
        return ", ".join(dict.fromkeys(what for record in records for what in left_of(self._platform, record)))

    def _ask(self, *links: str) -> list[Reply]:
        async def asked() -> list[Reply]:
            return [await ask(link, allowed=self._allowed) for link in links]

        return interruptible(asked())

    # The bots

    def _site(self) -> str:
        """The site answers over TLS, and tells browsers to use only TLS (HSTS)."""
        (reply,) = self._ask(self.bots[0].address)
        hsts = reply.headers.get("strict-transport-security", "")
        if reply.status != 200:
            raise CheckFailed(f"The first page is answered with {reply.status}.", LOGS)
        if not hsts:
            raise CheckFailed("It answers, without Strict-Transport-Security.", LOGS, Mark.LOOK)
        return f"It answers over TLS, with Strict-Transport-Security: {hsts}."

    def _links(self) -> str:
        """A link is refused without a signature, and with another participant's signature."""
        own, other = (self._copy.link(bot.report.user_id) for bot in (self.bots[0], self.bots[-1]))
        unsigned = own.partition("&signature=")[0]
        statuses = [reply.status for reply in self._ask(unsigned, f"{unsigned}&signature={other.rpartition('=')[2]}")]
        if not all(400 <= status < 500 for status in statuses):
            text = f"A link without its own signature was answered with {statuses}."
            raise CheckFailed(text, "Run `hippodrome deploy`.")
        return f"Without a signature: {statuses[0]}; with another's: {statuses[1]}."

    def _walk(self) -> str:
        """Every bot comes to the last page. Ctrl-C ends all bots."""
        interruptible(self._send_bots())
        reports = [bot.report for bot in self.bots]
        self._transcript.hide(*(report.code for report in reports))
        finished = sum(report.finished for report in reports)
        if finished < len(reports):
            reasons = [error for report in reports for error in report.errors]
            reasons += [f"step {report.ended} has no button to press" for report in reports if report.ended]
            why = "; ".join(dict.fromkeys(reasons)) or "they did not finish"
            raise CheckFailed(f"{finished} of {len(reports)} bots finished: {why}.", LOGS)
        sent = sum(len(report.answers) for report in reports)
        return f"{finished} of {len(reports)} bots finished, with {sent} forms answered."

    async def _send_bots(self) -> None:
        striking = asyncio.create_task(self._strike(self.bots[-1]))
        try:
            async with asyncio.timeout(self._left()):
                await walk(self.bots, at_once=len(self.bots), ramp=ARRIVALS, watch=self._watch)
        except TimeoutError:
            for bot in self.bots:
                if not bot.report.finished:
                    bot.report.errors.append("the time for the rehearsal was over")
        finally:
            striking.cancel()

    def _watch(self, reports: Sequence[BotReport]) -> None:
        stages = [report.stage for report in reports]
        self._progress("bots: " + ", ".join(f"{stages.count(stage)} {stage}" for stage in dict.fromkeys(stages)))

    async def _strike(self, victim: Bot) -> None:
        """Kill the victim's task, `STRUCK` seconds after its game began."""
        while not any(play.seconds >= STRUCK for play in victim.report.plays):
            await asyncio.sleep(0.2)
        try:
            await asyncio.to_thread(self._kill, victim)
            self._struck = True
        except Exception as error:  # noqa: BLE001 - the line `killed` shows it
            self._not_struck = f"{type(error).__name__}: {error}"

    def _kill(self, victim: Bot) -> None:
        record = self._record(victim)
        if record is None or record.task is None:
            raise LookupError("its task is not known")
        self._context.account.client("ecs").stop_task(cluster=record.cluster, task=record.task, reason=KILLED)

    def _servers(self) -> str:
        """Every bot got a server that became ready."""
        records = self._records()
        waited = [play.waited for bot in self.bots[:-1] for play in bot.report.plays if play.addresses]
        if len(waited) < len(self.bots) - 1 or not all(record.running for record in records):
            reasons = ", ".join(sorted({str(record.reason or record.state) for record in records}))
            raise CheckFailed(
                f"{len(waited)} of {len(self.bots) - 1} bots got a server ({reasons or 'none was asked for'}).",
                "See `hippodrome logs --all --function start_server` and `… --function task_changed`.",
            )
        ran = _range([_seconds(record.requested, record.running) for record in records])
        ready = _range([_seconds(record.running, record.ready) for record in records])
        return (
            f"{len(records)} ran, {sum(record.spot for record in records)} of them on Spot: they ran {ran} after their "
            f"request, and were ready {ready} later; bots waited {_range(waited)} on the game's page."
        )

    def _games(self) -> str:
        """Frames came, and each game came to its end."""
        plays = [play for bot in self.bots[:-1] for play in bot.report.plays]
        frames, done = sum(play.frames for play in plays), sum(play.done for play in plays)
        if not plays or done < len(plays) or not frames:
            troubles = "; ".join(dict.fromkeys(trouble for bot in self.bots for trouble in bot.report.troubles))
            raise CheckFailed(
                f"{done} of {len(plays)} games came to their end, with {frames} frames: "
                f"{troubles or 'nothing was said'}.",
                "See `hippodrome logs --all --function trial`. If no connection succeeds, this network may close the "
                "servers' port.",
            )
        rates = [rate for play in plays if (rate := play.received_rate)]
        speed = f", {min(rates):.0f} to {max(rates):.0f} a second" if rates else ""
        return f"{done} games came to their end, with {frames} frames{speed}."

    def _killed(self) -> str:
        """The victim's server was replaced, and the victim came to the end of its game there."""
        victim = self.bots[-1]
        record = self._record(victim)
        if not self._struck or record is None:
            raise CheckFailed(f"No task was killed: {self._not_struck}.", "These credentials need ecs:StopTask.")
        if not record.earlier or not victim.report.finished:
            raise CheckFailed(
                f"The task was killed, and its server not replaced: {record.reason or record.state}.",
                "See `hippodrome logs --all --function task_changed`.",
            )
        lost = record.earlier[0]
        return (
            f"The server counted as {lost.reason} ({lost.cause or 'no cause'}); another was ready "
            f"{_seconds(lost.closed, record.ready):.0f} s later, and the game went on to its end."
        )

    def _end(self) -> str:
        """The stop step ended every server, and nothing of the servers is left."""
        for bot in self.bots:
            if not bot.report.finished:  # it has not come to the step that stops its server
                self._platform.bus.publish(Topic.STOP, to_message(StopServer(self._copy.id, bot.report.user_id)))
        advice = "Run `hippodrome stop --all`; the sweep removes it too."
        self._until_gone(self._records(), GONE, "Something is left of a server", advice)
        records = self._records()
        reasons = ", ".join(sorted({str(record.reason) for record in records}))
        if not all(record.reason in (Reason.STOPPED, Reason.ENDED) for record in records):
            raise CheckFailed(f"The servers ended as {reasons}.", "See `hippodrome status --all`.")
        return f"{count(len(records), 'server')} ended ({reasons}); nothing of them is left."

    def _data(self) -> str:
        """`hippodrome data` fetches all answers and recordings of the bots."""
        self._progress("fetching the bots' data")
        context = self._context
        source = Bucket(context.account.client("s3"), context.installation["Bucket"], context.account.id)
        with tempfile.TemporaryDirectory(prefix="rehearsal-", ignore_cleanup_errors=True) as temporary:
            folder = Path(temporary)
            outcome = data.run(source, self._copy.id, folder / "data", data.Options(raw=True))
            stored = folder / "stored" / self._copy.id
            stored.mkdir(parents=True)
            for owners in ("users", "sessions"):
                (stored / owners).symlink_to(folder / "data" / "private" / "raw")
            recorded = bool(self._copy.project.trial.get("s3upload", True))
            reports = [bot.report for bot in self.bots]
            verification = verify(folder / "stored", self._copy.id, reports, recorded=recorded)
        # The recording of the killed server may lack its end, for each who played there.
        record = self._record(self.bots[-1])
        struck = tuple(
            f"{bot.report.user_id}, "
            for bot in self.bots
            if record and (own := self._record(bot)) and own.label == record.label
        )
        missing = [
            text for text in verification.missing if not (text.startswith(struck) and text.endswith("is cut off"))
        ]
        counts = outcome["counts"]
        if counts["problems"]:
            missing.append(f"{counts['problems']} files are not as they should be")
        if counts["participants"] != len(self.bots):
            missing.append(f"{counts['participants']} participants")
        if missing:
            raise CheckFailed(
                f"Of {len(self.bots)} bots: {'; '.join(missing)}.", "See `hippodrome logs --all --function trial`."
            )
        return (
            f"{verification.answers + verification.games} answers and {verification.recordings} recordings with "
            f"{verification.steps} steps, as they were sent and played."
        )

    # Without bots

    def _timer(self, lone: LoneServer) -> str:
        """A server that nobody stops is ended by its timer.

        The rehearsal does not wait for the project's `maxRuntime`. It checks that the ready server has a timer at its
        deadline, and moves the timer to the next minute, with the same name, role, topic and message.
        """
        record = lone.until_ready()
        if self._set_for(record) != record.deadline.astimezone(UTC).replace(microsecond=0):
            text = "It has no timer at its deadline."
            raise CheckFailed(text, "See `hippodrome logs --all --function start_server`.")
        at = self._platform.now() + SOON
        stop = StopServer(self._copy.id, lone.user_id, record.attempt, Reason.DEADLINE)
        self._platform.timers.set(record.name, at, to_message(stop))
        self._wait(
            lambda: "its server runs" if (running := lone.read()) and not running.is_closed else "",
            "waiting for the timer to fire",
            FIRED,
            "Its timer has not fired",
            "See `hippodrome logs --all --function stop_server`, and the schedule's role.",
        )
        closed = lone.read() or record
        if closed.reason is not Reason.DEADLINE:
            raise CheckFailed(f"It ended before its timer fired: {closed.reason}.", "See `hippodrome status --all`.")
        text = "Its timer fired, and something of the server is left"
        self._until_gone([closed], GONE, text, "Run `hippodrome stop --all`.")
        late = _seconds(at, closed.closed)
        return f"It stood at the deadline; moved nearer, it ended the server {late:.0f} s after its time."

    def _set_for(self, record: Server) -> datetime | None:
        scheduler, group = self._context.account.client("scheduler"), self._context.installation["ScheduleGroup"]
        try:
            expression = scheduler.get_schedule(GroupName=group, Name=record.name)["ScheduleExpression"]
        except scheduler.exceptions.ResourceNotFoundException:
            return None
        return datetime.strptime(expression, "at(%Y-%m-%dT%H:%M:%S)").replace(tzinfo=UTC)

    def _sweep(self, closed: Server | None) -> str:
        """The sweep removes the timer of a closed server, and its name. Without a domain servers have no names."""
        if closed is None or not closed.is_closed:
            raise CheckFailed("There is no closed server to leave something behind.", "See the line `timer`.")
        stop = StopServer(closed.project_id, closed.user_id, closed.attempt, Reason.DEADLINE)
        self._platform.timers.set(closed.name, self._platform.now() + timedelta(days=1), to_message(stop))
        made = ["its timer"]
        if closed.dns:
            self._platform.dns.change(add=[DnsRecord(closed.dns, NOWHERE)])
            made.append("its name")
        self._wait(
            lambda: ", ".join(what for what in made if what not in self._left_of([closed.user_id])),
            "waiting until AWS lists them",
            SEEN,
            "They were made, and AWS does not list them",
            "Run it again.",
        )
        self._progress("running the sweep")
        sweep = resource_names.function(self._context.installation.stack, "sweep")
        answer = self._context.account.client("lambda").invoke(FunctionName=sweep, Payload=b"{}")
        if answer.get("FunctionError"):
            kind = json.loads(answer["Payload"].read()).get("errorType", "it did not end")
            raise CheckFailed(f"The sweep failed: {kind}.", "See `hippodrome logs --all --function sweep --errors`.")
        text = "The sweep has left something of a closed server"
        self._until_gone([closed], SEEN, text, "See `hippodrome logs --all --function sweep`.")
        return f"It removed what a closed server had left: {', '.join(made)}."

    def _alarm(self) -> str:
        """An alarm that is set off by hand reaches its topic. Whether a mail arrives, only the mailbox's owner can see.

        CloudWatch sets an alarm back to its actual state by itself, often within seconds; its actions are in the
        alarm's history (CloudWatch API Reference, SetAlarmState).
        """
        account, installation = self._context.account, self._context.installation
        cloudwatch = account.client("cloudwatch")
        quiet = [alarm for alarm in snapshot.alarms(account, installation) if alarm["StateValue"] != "ALARM"]
        if not quiet:
            raise CheckFailed("There is no alarm that is quiet.", "Run `hippodrome deploy`, or see which alarms fire.")
        alarm = min(quiet, key=lambda candidate: str(candidate["AlarmName"]))
        name, began = alarm["AlarmName"], datetime.now(UTC) - timedelta(seconds=5)

        def missing() -> str:
            history = cloudwatch.describe_alarm_history(AlarmName=name, HistoryItemType="Action", StartDate=began)
            summaries = [item.get("HistorySummary", "").lower() for item in history["AlarmHistoryItems"]]
            return "" if any("success" in summary for summary in summaries) else "its history has no such action"

        cloudwatch.set_alarm_state(AlarmName=name, StateValue="ALARM", StateReason=ALARM_TEXT)
        try:
            text = "The alarm was set off, and its topic was not told"
            advice = "See the alarm's history in CloudWatch's console."
            self._wait(missing, "waiting until the alarm has reached its topic", ACTED, text, advice)
        finally:
            cloudwatch.set_alarm_state(AlarmName=name, StateValue=alarm["StateValue"], StateReason=ALARM_TEXT)
        confirmed = [
            line for line in snapshot.subscriptions(account, installation) if line["SubscriptionArn"].startswith("arn:")
        ]
        if not confirmed:
            raise CheckFailed(
                "An alarm was set off and reached its topic, which has no subscriber.",
                "Give `hippodrome deploy --no-study` an --email, and follow the link in AWS's e-mail.",
                Mark.LOOK,
            )
        whom = f"{len(confirmed)} {'address' if len(confirmed) == 1 else 'addresses'}"
        return f"An alarm was set off and reached its topic: a mail is on its way to {whom}."


def _seconds(begin: datetime | None, end: datetime | None) -> float:
    return max((end - begin).total_seconds(), 0.0) if begin and end else 0.0


def _range(values: Sequence[float]) -> str:
    """Write the range of these seconds in words: `3 s`, or `3 to 8 s`."""
    low, high = f"{min(values):.0f}", f"{max(values):.0f}"
    return f"{low} s" if low == high else f"{low} to {high} s"
