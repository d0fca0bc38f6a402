"""`doctor --rehearse`: starts and stops one real server through the installation's own topics, queues and functions."""

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
from hippodrome.control.ports import Platform, Topic
from hippodrome.control.servers import causes, resources
from hippodrome.control.storage.repository import Repository
from hippodrome.deployment.core import explain
from hippodrome.deployment.core.captured_log import functions_log
from hippodrome.deployment.core.finding import Finding, Mark, bad, good, look
from hippodrome.protocol.keys import session_key
from hippodrome.protocol.session import Member, SessionDocument, owner_folder

WAIT = 300.0  # seconds until a server should be ready; 45 to 90 are usual
CLAIM = 60.0  # seconds until start_server should have written the record
LEAVE = 150.0  # seconds until nothing of the server should be left
PAUSE = 2.0  # seconds between two looks
CHECK = "rehearsal"

Progress = Callable[[str], None]  # gets a text on each thing that happens
Reach = Callable[[str], object]  # sends a request to an https address; raises OSError without an answer

STAGES = {
    None: "the start message is on its way",
    ServerState.STARTING: "the server is starting",
    ServerState.NAMING: "it runs, and its name is being made known",
    ServerState.READY: "ready",
    ServerState.CLOSED: "closed",
}
REACHED = {ServerState.STARTING: "claimed", ServerState.NAMING: "running", ServerState.READY: "ready"}


class CheckFailed(Exception):
    """A part of a rehearsal has failed, or is worth a look. `advice` says what to do."""

    def __init__(self, text: str, advice: str, mark: Mark = Mark.BAD) -> None:
        super().__init__(text)
        self.advice = advice
        self.mark = mark


class LoneServer:
    """A server that no participant uses. In a project with sessions it is a session's server.

    `start` writes that session's document, since the sweep stops servers that were started ahead and got no session.
    """

    def __init__(
        self,
        platform: Platform,
        project: Project,
        progress: Progress = lambda _: None,
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._platform = platform
        self._project = project
        self._progress = progress
        self._clock = clock
        self._sleep = sleep
        self._repository = Repository(platform.documents)
        self._name = f"rehearsal-{secrets.token_hex(6)}"
        self.user_id = ids.new_session_id() if project.has_sessions else self._name
        self.record: Server | None = None  # as it was read last
        self.reached: dict[ServerState, float] = {}  # by state: seconds until it was reached

    def start(self) -> None:
        """Request the server, by a start message for a participant who never comes."""
        if self._project.has_sessions:
            session = SessionDocument(self.user_id, self._project.players, (Member(self._name, None, 0),))
            self._platform.documents.create(session_key(self._project.id, session.id), session.to_json())
        self._platform.bus.publish(Topic.START, to_message(StartServer(self._project.id, self.user_id)))

    def until_ready(self) -> Server:
        """Wait until the server is ready. Raises `CheckFailed`, which says why it is late or was closed."""
        began = self._clock()
        while True:
            seconds = self._clock() - began
            record = self.read()
            state = record.state if record else None
            self._progress(f"{seconds:3.0f} s  {STAGES[state]}")
            if record and not record.is_closed:
                self.reached.setdefault(record.state, seconds)
                if record.state is ServerState.READY:
                    return record
            if record and record.is_closed and next_attempt(record) is None:
                cause = causes.parse_cause(record.cause)
                why = cause.sentence if cause else "See `hippodrome logs --all --errors`."
                raise CheckFailed(f"The server was closed: {record.reason}.", why)
            if record is None and seconds > CLAIM:
                raise CheckFailed(
                    f"No function acted on the start message for {CLAIM:.0f} seconds.",
                    "See `hippodrome logs --all --function start_server`, and the dead letters of its queue.",
                )
            if seconds > WAIT:
                raise self._late(record)
            self._sleep(PAUSE)

    def read(self) -> Server | None:
        """Read the server's record; None as long as no function has written it."""
        record = self._repository.server_of(self._project.id, self.user_id)
        self.record = record or self.record
        return record

    def _late(self, record: Server | None) -> CheckFailed:
        """Explain why the server may be late, by its state and by whether ECS knows its task."""
        logs = "See `hippodrome logs --all --function"
        if record is None or record.state not in {ServerState.STARTING, ServerState.NAMING}:
            return CheckFailed(f"Not ready after {WAIT:.0f} seconds.", "See `hippodrome logs --all --errors`.")
        if record.state is ServerState.NAMING:
            text = f"It runs, and its name is not known everywhere, or it has no certificate, after {WAIT:.0f} seconds."
            return CheckFailed(text, f"{logs} task_changed`, or `… certify_server` without a domain.")
        if self._platform.tasks.find(record.name, record.cluster):
            text = f"Its task was started {WAIT:.0f} seconds ago, and no event of it has arrived."
            return CheckFailed(
                text, f"If the ECS console says that it runs, its event is missing. {logs} task_changed`."
            )
        text = f"There is no task after {WAIT:.0f} seconds: it was not run, or it ended at once."
        return CheckFailed(text, f"{logs} start_server` and `… --function trial`.")

    def visit(self, record: Server, reach: Reach) -> Finding:
        """Connect to the server as a browser does, which proves its name, the port, TLS and the certificate."""
        host = record.browser_host(self._platform.dns)
        self._progress(f"connecting to {host}")
        try:
            reach(f"https://{host}:{record.port}/")
        except OSError as error:
            reason = getattr(error, "reason", None) or error
            if isinstance(reason, ssl.SSLError):
                why = getattr(reason, "verify_message", "") or reason
                return bad(CHECK, f"Browsers will refuse it: {why}.", "Look at its certificate, above.")
            return look(
                CHECK,
                f"It cannot be reached from here: {reason}.",
                f"This network may close port {record.port}, as participants' networks may: try from another one.",
            )
        return good(CHECK, f"It answers at {host}:{record.port} over TLS.")

    def leave(self) -> list[Finding]:
        """Stop the server, and check that nothing of it is left. Delete its documents."""
        stop = StopServer(self._project.id, self.user_id)
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
            text = f"Not gone after {LEAVE:.0f} seconds: {', '.join(remaining)}."
            return [bad(CHECK, text, "Run `hippodrome stop --all`; the sweep removes it too.")]
        documents, project_id = self._platform.documents, self._project.id
        for entry in list(documents.list(owner_folder(project_id, self.user_id))):
            documents.delete(entry.key)
        if self.record and self.record.running:  # the record of a server that never ran stays, to prevent a late start
            documents.delete(server.key(self.record.label))
        findings = [good(CHECK, "It was stopped, and nothing of it is left.")]
        if helped:
            text = "No function has acted on the stop message, so this command stopped the server."
            findings.append(look(CHECK, text, "See `hippodrome logs --all --function stop_server`."))
        return findings

    def _left(self) -> list[str]:
        # Without a record, a function may still start the server. The stop message makes a closed record, which
        # prevents that.
        record = self.read()
        return left_of(self._platform, record) if record else ["the start message"]

    def _stop_from_here(self, stop: StopServer) -> None:
        from hippodrome.control.servers.services import ServerServices  # noqa: PLC0415 - Powertools
        from hippodrome.control.servers.termination import Termination  # noqa: PLC0415 - Powertools

        with functions_log():
            Termination(ServerServices(self._platform)).stop([stop])


def left_of(platform: Platform, record: Server) -> list[str]:
    """Return what is left of a server, in words; empty if its record is closed and nothing else is there."""
    if not record.is_closed:
        return ["its record"]
    return [f"its {kind}" for kind in resources.list_resources(platform).only(lambda name: name == record.name).kinds()]


def rehearse(lone: LoneServer, project: Project, findings: list[Finding], reach: Reach | None) -> None:
    """Start a server of the project, connect to it, stop it, and check that nothing is left; add the findings.

    The server is stopped in any case, also after Ctrl-C.
    """
    try:
        lone.start()
        record = lone.until_ready()
        kind = "on Spot" if record.spot else "on demand: Spot had no room"
        subject = "A warm server" if record.warm_server_name else "A server"
        took = ", ".join(f"{REACHED[state]} after {seconds:.0f} s" for state, seconds in lone.reached.items())
        findings.append(good(CHECK, f"{subject} of {project.id}, {kind}: {took}."))
        if reach is not None:
            findings.append(lone.visit(record, reach))
    except CheckFailed as failure:
        findings.append(bad(CHECK, str(failure), failure.advice))
    except Exception as error:
        problem = explain.problem_from(error)
        if problem is None:
            raise
        findings.append(bad(CHECK, str(problem), problem.advice))
    finally:
        findings += lone.leave()
