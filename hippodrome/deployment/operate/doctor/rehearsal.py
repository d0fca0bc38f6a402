"""Starts and stops one real server through the installation's own topics, queues and functions."""

from __future__ import annotations

import contextlib
import secrets
import ssl
import time
from collections.abc import Callable

from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server, ServerState, next_attempt
from hippodrome.control.ports import Documents, Platform, Topic
from hippodrome.control.servers import causes, resources
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.core.captured_log import functions_log
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.operate.doctor.check_context import CheckContext, CheckFailed
from hippodrome.protocol.keys import session_key
from hippodrome.protocol.session import Member, SessionDocument, owner_folder

WAIT = 300.0  # seconds until a server should be ready; 45 to 90 are usual
CLAIM = 60.0  # seconds until start_server should have written the record
LEAVE = 150.0  # seconds until nothing of the server should be left
PAUSE = 2.0  # seconds between two looks
CHECK = "rehearsal"

Reach = Callable[[str], object]  # sends a request to an https address; raises OSError without an answer

STAGES = {
    None: "the start message is on its way",
    ServerState.STARTING: "the server is starting",
    ServerState.NAMING: "it runs, and its name is being made known",
    ServerState.READY: "ready",
    ServerState.CLOSED: "closed",
}
REACHED = {ServerState.STARTING: "claimed", ServerState.NAMING: "running", ServerState.READY: "ready"}


class Rehearsal:
    """Starts and stops one server without a participant. `progress` gets a text on each thing that happens.

    In a project with sessions it is a session's server. The rehearsal writes the session's document, since the sweep
    stops servers that were started ahead and got no session.
    """

    def __init__(
        self,
        platform: Platform,
        project: Project,
        progress: Callable[[str], None] = lambda _: None,
        *,
        reach: Reach | None = None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._reach = reach
        self._platform = platform
        self._project = project
        self._progress = progress
        self._clock = clock
        self._sleep = sleep
        self._repository = Repository(platform.documents)
        self._name = f"rehearsal-{secrets.token_hex(6)}"
        self.user_id = ids.new_session_id() if project.has_sessions else self._name
        self._seconds: dict[ServerState, float] = {}  # by state of the server: the seconds from the start message to it
        self.left: list[Finding] = []  # findings on what is left after an interruption
        self._record: Server | None = None

    def run(self) -> list[Finding]:
        """Start the server, wait until it is ready, stop it, and check that nothing is left.

        After Ctrl-C it cleans up as well; then `left` has the findings, and the exception is raised again.
        """
        findings: list[Finding] = []
        try:
            started = self._clock()
            if self._project.has_sessions:
                session = SessionDocument(self.user_id, self._project.players, (Member(self._name, None, 0),))
                write_session(self._platform.documents, self._project.id, session)
            self._platform.bus.publish(Topic.START, to_message(StartServer(self._project.id, self.user_id)))
            self._until_ready(started)
            kind = "on Spot" if self._record and self._record.spot else "on demand: Spot had no room"
            subject = "A warm server" if self._record and self._record.warm_server_name else "A server"
            took = ", ".join(f"{REACHED[state]} after {seconds:.0f} s" for state, seconds in self._seconds.items())
            findings.append(good(CHECK, f"{subject} of {self._project.id}, {kind}: {took}."))
            findings += self._visit()
        except CheckFailed as failure:
            findings.append(bad(CHECK, str(failure), failure.advice))
        except BaseException:
            self.left = self._leave()
            raise
        return findings + self._leave()

    def _until_ready(self, started: float) -> None:
        while True:
            seconds = self._clock() - started
            record = self._repository.server_of(self._project.id, self.user_id)
            self._record = record or self._record
            state = record.state if record else None
            self._progress(f"{seconds:3.0f} s  {STAGES[state]}")
            if record and state is not ServerState.CLOSED:
                self._seconds.setdefault(record.state, seconds)
            if state is ServerState.READY:
                return
            if record and record.is_closed and next_attempt(record) is None:
                raise CheckFailed(f"The server was closed: {record.reason}.", _why(record))
            if record is None and seconds > CLAIM:
                raise CheckFailed(
                    f"No function acted on the start message for {CLAIM:.0f} seconds.",
                    "See `hippodrome logs --all --function start_server`, and the dead letters of its queue.",
                )
            if seconds > WAIT:
                raise self._late(record)
            self._sleep(PAUSE)

    def _late(self, record: Server | None) -> CheckFailed:
        """Explain why the server may be late, by its state and by whether ECS knows its task."""
        if record is not None and record.state is ServerState.STARTING:
            if self._platform.tasks.find(record.name, record.cluster):
                return CheckFailed(
                    f"Its task was started {WAIT:.0f} seconds ago, and no event of it has arrived.",
                    "See the task in the ECS console; if it runs, its event is missing: "
                    "`hippodrome logs --all --function task_changed`.",
                )
            return CheckFailed(
                f"There is no task after {WAIT:.0f} seconds.",
                "It was not run, or it ended at once: see `hippodrome logs --all --function start_server` and "
                "`… --function trial`.",
            )
        if record is not None and record.state is ServerState.NAMING:
            return CheckFailed(
                f"It runs, and its name is not known everywhere, or it has no certificate, after {WAIT:.0f} seconds.",
                "See `hippodrome logs --all --function task_changed`, or `… certify_server` without a domain.",
            )
        return CheckFailed(f"Not ready after {WAIT:.0f} seconds.", "See `hippodrome logs --all --errors`.")

    def _visit(self) -> list[Finding]:
        """Connect to the server as a browser does, which proves its name, the port, TLS and the certificate."""
        record = self._record
        if self._reach is None or record is None or record.host is None:
            return []
        host = record.browser_host(self._platform.dns)
        self._progress(f"connecting to {host}")
        try:
            self._reach(f"https://{host}:{record.port}/")
        except OSError as error:
            reason = getattr(error, "reason", None) or error
            if isinstance(reason, ssl.SSLError):
                why = getattr(reason, "verify_message", "") or reason
                return [bad(CHECK, f"Browsers will refuse it: {why}.", "Look at its certificate, above.")]
            return [
                look(
                    CHECK,
                    f"It cannot be reached from here: {reason}.",
                    f"This network may close port {record.port}, as participants' networks may: try from another one.",
                )
            ]
        return [good(CHECK, f"It answers at {host}:{record.port} over TLS.")]

    # Afterwards

    def _leave(self) -> list[Finding]:
        """Stop the server, and check that nothing of it is left."""
        stop = StopServer(self._project.id, self.user_id)
        self._progress("stopping it")
        with contextlib.suppress(Exception):  # if this fails, this machine stops the server below
            self._platform.bus.publish(Topic.STOP, to_message(stop))
        end = self._clock() + LEAVE
        helped = False
        while (remaining := self._left()) and self._clock() < end:
            if self._clock() > end - LEAVE / 2 and not helped:  # the functions have not stopped the server
                helped = True
                self._stop_from_here(stop)
            self._progress(f"stopping it: {', '.join(remaining)}")
            self._sleep(PAUSE)
        if remaining:
            return [
                bad(
                    CHECK,
                    f"Not gone after {LEAVE:.0f} seconds: {', '.join(remaining)}.",
                    "Run `hippodrome stop --all`; the sweep removes it too.",
                )
            ]
        ran = self._record is not None and self._record.running is not None
        self._delete_documents(ran)
        diagnoses = [good(CHECK, "It was stopped, and nothing of it is left.")]
        if helped:
            diagnoses.append(
                look(
                    CHECK,
                    "No function has acted on the stop message, so this command stopped the server.",
                    "See `hippodrome logs --all --function stop_server`.",
                )
            )
        return diagnoses

    def _left(self) -> list[str]:
        """Find what is left of the server, in words."""
        record = self._repository.server_of(self._project.id, self.user_id)
        if record is None:
            # A function may still start the server. The stop message makes a closed record, which prevents that.
            return ["the start message"]
        self._record = record
        if not record.is_closed:
            return ["its record"]
        remaining = resources.list_resources(self._platform).only(lambda name: name == record.name)
        return [f"its {kind}" for kind in remaining.kinds()]

    def _stop_from_here(self, stop: StopServer) -> None:
        from hippodrome.control.servers.services import ServerServices  # noqa: PLC0415 - Powertools
        from hippodrome.control.servers.termination import Termination  # noqa: PLC0415 - Powertools

        with functions_log():
            Termination(ServerServices(self._platform)).stop([stop])

    def _delete_documents(self, ran: bool) -> None:
        """Delete the rehearsal's documents. The record of a server that never ran stays, to prevent a late start."""
        documents, project_id = self._platform.documents, self._project.id
        for entry in list(documents.list(owner_folder(project_id, self.user_id))):
            documents.delete(entry.key)
        record = self._repository.server_of(self._project.id, self.user_id)
        if ran and record:
            documents.delete(server.key(record.label))


def write_session(documents: Documents, project_id: str, session: SessionDocument) -> None:
    """Write the document of a session. Without it, the sweep would stop the session's server."""
    documents.create(session_key(project_id, session.id), session.to_json())


def _why(record: Server) -> str:
    cause = causes.parse_cause(record.cause)
    return cause.sentence if cause else "See `hippodrome logs --all --errors`."


def project_for(context: CheckContext) -> Project | None:
    """Choose the first live project with a game, to start its server; None if there is none."""
    return next((p for p in context.projects if p.live and p.game_steps and p.task_definition), None)
