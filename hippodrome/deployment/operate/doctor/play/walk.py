"""The bots' part of a rehearsal: links, pages, servers, games, a killed task, the stop step, and the data."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

from hippodrome.bots import verification
from hippodrome.bots.bot import Bot
from hippodrome.bots.crowd import interruptible, walk
from hippodrome.bots.http import ask
from hippodrome.bots.report import BotReport
from hippodrome.console.formatting import count
from hippodrome.control.model.messages import StopServer, to_message
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import Topic
from hippodrome.control.servers import resources
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.operate.doctor.check_context import CheckFailed
from hippodrome.deployment.operate.doctor.play.scene import RehearsalContext
from hippodrome.deployment.operate.doctor.play.transcript import shown
from hippodrome.export import run as data
from hippodrome.export.bucket import Bucket

PLAY = 8.0  # seconds that a bot plays
VICTIM_PLAYS = 25.0  # seconds that the victim, whose task is killed, plays: its game must still run then
STRUCK = 2.0  # seconds of play after which its task is killed
ARRIVALS = 1.0  # seconds between the arrivals of two bots
GONE = 240.0  # seconds until nothing of the last server may be left: stopTimeout is 120
KILLED = "Rehearsal: killed, as when a Spot task is interrupted"
"""The reason that StopTask gets. ECS puts it into the task's `stoppedReason` (ECS API Reference, StopTask). It counts
as a Spot interruption in `hippodrome/control/model/messages.py`, whatever the stop code: the server is lost."""

LOGS = "See `hippodrome logs --all --errors`."


class Walk:
    """Sends bots through the copy (`run`). Each other method checks one result, and adds a line to the transcript."""

    def __init__(self, scene: RehearsalContext, bots: int) -> None:
        self._scene = scene
        bots += -(bots + 1) % scene.copy.project.players  # bots and victim together fill whole sessions
        self.bots = [scene.bot(f"{number}", PLAY) for number in range(1, bots + 1)]
        self.victim = scene.bot("victim", VICTIM_PLAYS)
        self._struck: Server | None = None  # the record of the server whose task was killed
        self._not_struck = "its game never began"
        self.records: dict[str, Server] = {}  # bot's id → its server; the bots of a session have the same one

    @property
    def all(self) -> list[Bot]:
        """All bots; the victim, whose task is killed, is the last."""
        return [*self.bots, self.victim]

    @property
    def ran(self) -> list[Server]:
        """The bots' servers, each once."""
        return each_once(self.records.values())

    # Links

    def links(self) -> None:
        """Check that a link is refused without a signature, and with another participant's signature."""
        scene = self._scene
        own, other = scene.copy.link(self.bots[0].report.user_id), scene.copy.link(self.victim.report.user_id)
        unsigned = own.partition("&signature=")[0]
        forged = f"{unsigned}&signature={other.rpartition('=')[2]}"

        async def asked() -> list[int]:
            return [(await ask(address, allowed=scene.where)).status for address in (unsigned, forged)]

        statuses = interruptible(asked())
        if all(400 <= status < 500 for status in statuses):
            scene.transcript.good("links", f"Without a signature: {statuses[0]}; with another's: {statuses[1]}.")
        else:
            scene.transcript.bad(
                "links",
                f"A link without its own signature was answered with {statuses}.",
                "Run `hippodrome apply`.",
            )

    def site(self) -> None:
        """Check that the site answers over TLS, and tells browsers to use only TLS (HSTS)."""
        scene = self._scene

        async def asked() -> tuple[int, str]:
            reply = await ask(scene.copy.link(self.bots[0].report.user_id), allowed=scene.where)
            return reply.status, reply.headers.get("strict-transport-security", "")

        status, hsts = interruptible(asked())
        if status != 200:
            scene.transcript.bad("site", f"The first page is answered with {status}.", LOGS)
        elif not hsts:
            scene.transcript.say("site", Mark.LOOK, "It answers, without Strict-Transport-Security.", LOGS)
        else:
            scene.transcript.good("site", f"It answers over TLS, with Strict-Transport-Security: {hsts}.")

    # Walking

    def run(self) -> None:
        """Send all bots, and kill the victim's task. KeyboardInterrupt ends all bots."""
        interruptible(self._walk())

    async def _walk(self) -> None:
        striking = asyncio.create_task(self._strike())
        try:
            async with asyncio.timeout(self._scene.left()):
                await walk(self.all, at_once=len(self.all), ramp=ARRIVALS, watch=self._watch)
        except TimeoutError:
            for bot in self.all:
                if not bot.report.finished:
                    bot.report.errors.append("the time for the rehearsal was over")
        finally:
            striking.cancel()

    def _watch(self, reports: Sequence[BotReport]) -> None:
        stages = [report.stage for report in reports]
        self._scene.progress("bots: " + ", ".join(f"{stages.count(stage)} {stage}" for stage in dict.fromkeys(stages)))

    async def _strike(self) -> None:
        """Kill the victim's task, `STRUCK` seconds after its game began."""
        while not any(play.seconds >= STRUCK for play in self.victim.report.plays):
            await asyncio.sleep(0.2)
        try:
            self._struck = await asyncio.to_thread(self._kill)
        except Exception as error:  # noqa: BLE001 - the rehearsal's line `killed` shows it
            self._not_struck = f"{type(error).__name__}: {error}"

    def _kill(self) -> Server | None:
        record = self._scene.server(self.victim.report.user_id)
        if record is None or record.task is None:
            self._not_struck = "its task is not known"
            return None
        ecs = self._scene.context.account.client("ecs")
        ecs.stop_task(cluster=record.cluster, task=record.task, reason=KILLED)
        return record

    # The results

    def pages(self) -> None:
        """Check that every bot came to the last page."""
        reports = [bot.report for bot in self.all]
        for report in reports:
            self._scene.transcript.hide(report.code, report.user_id)
        finished, sent = sum(report.finished for report in reports), sum(len(report.answers) for report in reports)
        if finished == len(reports):
            self._scene.transcript.good("pages", f"{finished} of {finished} bots finished, with {sent} forms answered.")
            return
        reasons = [error for report in reports for error in report.errors]
        reasons += [f"step {report.ended} has no button to press" for report in reports if report.ended]
        why = "; ".join(dict.fromkeys(reasons)) or "they did not finish"
        self._scene.transcript.bad("pages", f"{finished} of {len(reports)} bots finished: {why}.", LOGS)

    def servers(self) -> None:
        """Check that every bot got a server that became ready. Tell how many were on Spot, and how long bots waited."""
        transcript = self._scene.transcript
        records = {bot: self._scene.server(bot.report.user_id) for bot in self.all}
        self.records = {bot.report.user_id: record for bot, record in records.items() if record}
        waited = [play.waited for bot in self.bots for play in bot.report.plays if play.addresses]
        if len(waited) < len(self.bots) or not all(record.running for record in self.ran):
            reasons = sorted({str(record.reason or record.state) for record in self.ran})
            transcript.bad(
                "servers",
                f"{len(waited)} of {len(self.bots)} bots got a server ({', '.join(reasons) or 'none was asked for'}).",
                "See `hippodrome logs --all --function start_server` and `… --function task_changed`.",
            )
            return
        spot = sum(record.spot for record in self.ran)
        transcript.good(
            "servers",
            f"{len(self.ran)} ran, {spot} of them on Spot; bots waited {shown(waited)} on the game's page.",
            waited=[round(seconds, 1) for seconds in waited],
        )

    def games(self) -> None:
        """Check that the bots played: frames came, and each game came to its end."""
        plays = [play for bot in self.bots for play in bot.report.plays]
        frames, done = sum(play.frames for play in plays), sum(play.done for play in plays)
        if plays and done == len(plays) and frames:
            rates = [rate for play in plays if (rate := play.received_rate)]
            speed = f", {min(rates):.0f} to {max(rates):.0f} a second" if rates else ""
            self._scene.transcript.good("game", f"{done} games came to their end, with {frames} frames{speed}.")
            return
        troubles = "; ".join(dict.fromkeys(trouble for bot in self.bots for trouble in bot.report.troubles))
        self._scene.transcript.bad(
            "game",
            f"{done} of {len(plays)} games came to their end, with {frames} frames: {troubles or 'nothing was said'}.",
            "See `hippodrome logs --all --function trial`. If no connection succeeds, this network may close the "
            "servers' port.",
        )

    def killed(self) -> None:
        """Check that the victim's server was replaced, and that the victim came to the end of its game there."""
        transcript, report = self._scene.transcript, self.victim.report
        record = self.records.get(report.user_id)
        if self._struck is None or record is None:
            transcript.bad("killed", f"No task was killed: {self._not_struck}.", "These credentials need ecs:StopTask.")
            return
        first_attempt = record.earlier[0] if record.earlier else None
        if record.attempt < 2 or first_attempt is None or not report.finished:
            transcript.bad(
                "killed",
                f"The task was killed, and its server not replaced: {record.reason or record.state}.",
                "See `hippodrome logs --all --function task_changed`.",
            )
            return
        again = (record.ready or record.requested) - (first_attempt.closed or record.requested)
        transcript.good(
            "killed",
            f"The server counted as {first_attempt.reason} ({first_attempt.cause or 'no cause'}); another was ready "
            f"{again.total_seconds():.0f} s later, and the game went on to its end.",
            again=round(again.total_seconds(), 1),
        )

    def end(self) -> None:
        """Check that the stop step ended every server, and that nothing of the servers is left."""
        scene, users = self._scene, [bot.report.user_id for bot in self.all]
        late = CheckFailed("Something is left of a server: ", "Run `hippodrome stop --all`; the sweep removes it too.")
        for bot in self.all:
            if not bot.report.finished:  # it has not come to the step that stops its server
                stop = StopServer(scene.copy.id, bot.report.user_id)
                scene.platform.bus.publish(Topic.STOP, to_message(stop))

        def gone() -> bool | None:
            self._left = [text for user in users for text in left(scene, user)]
            return None if self._left else True

        try:
            scene.wait(gone, "waiting until the servers are gone", GONE, late)
        except CheckFailed as failed:
            scene.transcript.bad("end", f"{failed}{', '.join(dict.fromkeys(self._left))}.", failed.advice)
            return
        self.records = {user: record for user in users if (record := scene.server(user))}
        reasons = sorted({str(record.reason) for record in self.ran})
        expected = {Reason.STOPPED, Reason.ENDED}
        if not all(record.reason in expected for record in self.ran):
            scene.transcript.bad("end", f"The servers ended as {', '.join(reasons)}.", "See `hippodrome status --all`.")
            return
        scene.transcript.good(
            "end", f"{count(len(self.ran), 'server')} ended ({', '.join(reasons)}); nothing of them is left."
        )

    def _played_with_the_victim(self) -> list[Bot]:
        """Return the victim, and the bots of its session."""
        record = self.records.get(self.victim.report.user_id)
        own = {user for user, other in self.records.items() if record and other.label == record.label}
        return [bot for bot in self.all if bot is self.victim or bot.report.user_id in own]

    def data(self) -> None:
        """Check that `deploy data` fetches all answers and recordings of the bots."""
        scene, context = self._scene, self._scene.context
        scene.progress("fetching the bots' data")
        source = Bucket(context.account.client("s3"), context.installation["Bucket"], context.account.id)
        recorded = bool(scene.copy.project.trial.get("s3upload", True))
        with tempfile.TemporaryDirectory(prefix="rehearsal-", ignore_cleanup_errors=True) as temporary:
            folder = Path(temporary)
            outcome = data.run(source, scene.copy.id, folder / "data", data.Options(raw=True))
            stored = folder / "stored" / scene.copy.id
            stored.mkdir(parents=True)
            for owners in ("users", "sessions"):
                (stored / owners).symlink_to(folder / "data" / "private" / "raw")
            struck = self._played_with_the_victim()
            others = [bot for bot in self.all if bot not in struck]
            verifications = [
                verification.verify(folder / "stored", scene.copy.id, [bot.report for bot in bots], recorded=recorded)
                for bots in (others, struck)
            ]
        of_others, of_struck = verifications
        # The recording of a killed server may lack its end.
        missing = [*of_others.missing, *(name for name in of_struck.missing if not name.endswith("is cut off"))]
        counts = outcome["counts"]
        if counts["problems"]:
            missing.append(f"{counts['problems']} files are not as they should be")
        if counts["participants"] != len(self.all):
            missing.append(f"{counts['participants']} participants")
        if missing:
            scene.transcript.bad(
                "data",
                f"Of {len(self.all)} bots: {'; '.join(missing)}.",
                "See `hippodrome logs --all --function trial`.",
            )
            return
        answers = sum(verification.answers + verification.games for verification in verifications)
        recordings = sum(verification.recordings for verification in verifications)
        steps = sum(verification.steps for verification in verifications)
        scene.transcript.good(
            "data", f"{answers} answers and {recordings} recordings with {steps} steps, as they were sent and played."
        )


def each_once(records: Iterable[Server]) -> list[Server]:
    """Remove repetitions: the members of a session have the same server."""
    return list({record.label: record for record in records}.values())


def left(scene: RehearsalContext, user: str) -> list[str]:
    """Find what is left of a bot's server, in words; empty if the bot never had a server."""
    record = scene.server(user)
    if record is None:
        return []
    if record.state is not ServerState.CLOSED:
        return ["a record that is not closed"]
    remaining = resources.list_resources(scene.platform).only(lambda name: name == record.name)
    return [f"a {kind}" for kind in remaining.kinds()]
