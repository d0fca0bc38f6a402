"""`start_server`: creates the server's record, takes a slot if the project has limits, sets the timer, runs the task.

With `warmServers` a participant or a session is assigned a warm server instead, if one is ready. In a project with
sessions a participant's message starts no server of their own: it tells the lobby that they are under way.
"""

from __future__ import annotations

import json
import secrets
from dataclasses import replace
from datetime import timedelta

from hippodrome.control.certificates.rules import ADDRESS_ORDERS, MAX_ORDERS_AT_START, AddressOrders, location
from hippodrome.control.log import logger
from hippodrome.control.model import ids, server
from hippodrome.control.model.matching import MATCH
from hippodrome.control.model.messages import KeepWarm, StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.model.sessions import lifetime_asked_for
from hippodrome.control.ports import Conflict, NoCapacity, Refused, Settings, TaskRequest, Topic
from hippodrome.control.servers import causes
from hippodrome.control.servers.replacement import Replacement
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.termination import Termination
from hippodrome.control.storage.compare_and_swap import SharedDocuments
from hippodrome.control.storage.project_cache import FRESH
from hippodrome.control.storage.repository import Versioned
from hippodrome.control.storage.secret import Secret
from hippodrome.protocol import environment
from hippodrome.protocol.session import is_session_id


class Start:
    """Starts the servers that messages of the start topic ask for."""

    def __init__(self, services: ServerServices) -> None:
        self._services = services
        self._platform = services.platform
        self._repository = services.repository

    def handle(self, message: StartServer | KeepWarm) -> None:
        """Start the requested server, only once even if the message comes again; or adjust a pool of warm servers."""
        if isinstance(message, KeepWarm):
            self._services.pools.adjust(message.keep_warm)
        else:
            self._handle_start(message)

    def _handle_start(self, message: StartServer) -> None:
        # A warm server must run the present registration, which may be newer than the cached list.
        fresh = timedelta(0) if ids.is_warm_id(message.user_id) else FRESH
        of_session = is_session_id(message.user_id)
        fits = (lambda listed: listed.has_sessions) if of_session else None
        project = self._services.project_cache.live_project(message.project_id, fresh, fits=fits)
        if project is None or (of_session and not project.has_sessions):
            self._cancel_start(message)
            return
        if project.has_sessions and ids.is_user_id(message.user_id):
            before = self._repository.project_of_own_server(project, message.user_id)
            if before is None:
                self._services.lobby.under_way(project, message.user_id)
                return
            project = before
        if of_session:
            project = self._for_session(project, message)
        self._services.secrets.get_or_create()  # it must exist before anything that needs it is written
        stored = self._create_or_find(project, message)
        if stored is None:
            return
        record = stored.server
        if not self._may_get_certificate(record) or not self._services.slots.acquire(project, record):
            self._close_as_full(stored)
            return
        own = self._assign_warm_server(project, stored)
        if own is not None:
            self._start(project, own)

    def _for_session(self, project: Project, message: StartServer) -> Project:
        """The project as it was registered last for this session's number of players.

        The start message of a replacement does not say the number. Then it is read from the record of the session's
        server, which is one AWS call.
        """
        players = message.players
        if not players:
            stored = self._repository.stored_server(project.id, message.user_id)
            players = stored.server.players if stored else 0
        now = self._services.project_cache.live_project(project.id, fits=lambda listed: listed.for_session(players))
        registration = now and now.for_session(players)
        if registration is None:
            logger.error("nothing is registered for a session of so many players", extra={"project": project.id})
        return registration or project

    def _cancel_start(self, message: StartServer) -> None:
        """Start nothing: the project is closed, or has no sessions any more. If the server was started, stop it."""
        logger.warning("a start message was dropped: its project is closed, or has no sessions any more")
        stored = self._repository.stored_server(message.project_id, message.user_id)
        if stored and stored.server.is_open(message.attempt) and stored.server.state is ServerState.STARTING:
            stop = StopServer(message.project_id, message.user_id, message.attempt, Reason.STOPPED)
            self._platform.bus.publish(Topic.STOP, to_message(stop))

    def _assign_warm_server(self, project: Project, stored: Versioned) -> Versioned | None:
        """Assign a warm server and return None; if none is ready, return the record of the server to start.

        Warm servers run on Spot. After two losses on Spot a participant's server starts on demand instead.
        """
        record = stored.server
        warm = project.warm_servers and record.spot and not record.is_warm_server
        reserved = self._services.handovers.reserve(project, stored) if warm or record.warm_server_name else None
        if reserved is None:
            return stored
        if self._services.handovers.assign(project, reserved):
            return None
        again = self._new_record(project, record.user_id, record.attempt)
        return self._repository.update(
            reserved, lambda r: server.without_warm_server(r, again) if r.owns(reserved.server.name) else None
        )

    def _start(self, project: Project, stored: Versioned) -> None:
        """Set the timer and run the task. If the task can never run, close the record."""
        record = stored.server
        # The timer comes first, so that no resource outlives the deadline even if this function is interrupted.
        stop = StopServer(record.project_id, record.user_id, record.attempt, Reason.DEADLINE)
        self._platform.timers.set(record.name, record.deadline, to_message(stop))
        try:
            if record.has_own_cluster:
                self._platform.tasks.create_cluster(record.cluster)
            self._run(project, stored)
        except (NoCapacity, Refused) as error:
            logger.error("the server cannot run", extra={"server": record.name, "why": type(error).__name__})
            present = self._repository.server(record.label)
            if present is None or not present.server.owns(record.name):
                return  # another delivery of the message got a warm server, which holds the slot now
            reason = Reason.REFUSED if isinstance(error, Refused) else Reason.NO_CAPACITY
            Termination(self._services).clean_up_lost(stored, reason, causes.cause_of_refusal(error))
            return
        logger.info("server starting", extra={"server": record.name})

    def _create_or_find(self, project: Project, message: StartServer) -> Versioned | None:
        """Create or find the record of the attempt to start; None if this attempt has started or may not start."""
        new = self._new_record(project, message.user_id, message.attempt)
        try:
            if message.attempt > 1:
                return Replacement(self._services).write_record(new)
            return self._repository.create(new)
        except Conflict:
            stored = self._repository.server(new.label)
        if stored and server.found_no_slot(stored.server, message.attempt):
            return self._repository.update(
                stored, lambda r: server.repeating(r, new) if server.found_no_slot(r, message.attempt) else None
            )
        unfinished = stored and stored.server.is_open(message.attempt) and stored.server.state is ServerState.STARTING
        return stored if unfinished else None

    def _may_get_certificate(self, record: Server) -> bool:
        """Whether the authority still takes orders for addresses, so that this server will not be started in vain."""
        if record.dns:
            return True
        orders = SharedDocuments(self._platform.documents).read(ADDRESS_ORDERS, AddressOrders)
        allowed = orders.allows(self._platform.now(), MAX_ORDERS_AT_START)
        if not allowed:
            logger.error("the limit of certificates is reached: no server can start", extra={"server": record.name})
        return allowed

    def _close_as_full(self, stored: Versioned) -> None:
        """Close the record with the reason `full`, which the waiting page shows, because the limits are reached."""
        record, now = stored.server, self._platform.now()
        self._repository.update(stored, lambda r: server.close(r, Reason.FULL, now) if r.owns(record.name) else None)
        if record.is_warm_server:
            self._services.pools.remove(record.project_id, record.user_id)
        logger.warning("the project is full", extra={"server": record.name, "project": record.project_id})

    def _new_record(self, project: Project, user_id: str, attempt: int) -> Server:
        """The record of a new attempt, with a new nonce."""
        settings, now = self._platform.settings, self._platform.now()
        return server.new_attempt(
            project, user_id, attempt, nonce=secrets.token_urlsafe(12), settings=settings, now=now
        )

    def _run(self, project: Project, stored: Versioned) -> None:
        """Run the task on Spot, or on demand if Spot has no capacity. Raises `NoCapacity` or `Refused`.

        The task's id is not recorded here: a repetition finds the same task by its name, and the RUNNING event brings
        the id. If the server was closed meanwhile, that event stops the task.
        """
        record = stored.server
        request = TaskRequest(
            name=record.name,
            definition=project.task_definition or self._platform.settings.task_definition,
            cluster=record.cluster,
            cpu=project.size.cpu,
            memory=project.size.memory,
            environment=_environment(project, record, self._platform.settings, self._services.secrets.get_or_create()),
            port=record.port,
            spot=record.spot,
            nonce=record.nonce,
        )
        try:
            self._platform.tasks.run(request)
        except NoCapacity:
            if not record.spot:
                raise
            logger.warning("there is no Spot capacity: the server runs on demand", extra={"server": record.name})
            if self._repository.update(stored, lambda r: server.on_demand(r) if r.owns(record.name) else None):
                self._platform.tasks.run(replace(request, spot=False))


def _environment(project: Project, record: Server, settings: Settings, secret: Secret) -> dict[str, str]:
    """The environment variables of a trial server (`hippodrome/protocol/environment.py`)."""
    return {
        **_owner_environment(project, record, settings),
        **({environment.MATCHING: MATCH} if project.asks_match else {}),
        **({environment.ASSIGNMENT: "on"} if project.assigns else {}),
        **_plain_environment(project, record, settings),
        environment.PROJECT_ID: record.project_id,
        environment.SERVER: record.name,
        environment.TOKEN: secret.token(record),
        environment.CREDENTIAL: secret.credential(record.name, record.nonce),
        environment.GAME_STEPS: ",".join(project.game_steps),
        environment.TRIAL: json.dumps(project.trial, separators=(",", ":")),
        **_certificate_environment(record, settings),
    }


def _certificate_environment(record: Server, settings: Settings) -> dict[str, str]:
    """The variables that say where the server gets its certificate."""
    if not record.dns:
        return {environment.CERTIFICATE: settings.certificate_url}
    certificate = location(record.domain)
    return {environment.SSL_FULLCHAIN: certificate.fullchain, environment.SSL_PRIVKEY: certificate.privkey}


def _owner_environment(project: Project, record: Server, settings: Settings) -> dict[str, str]:
    """The variables that name the server's owner and deadline. A warm server has no owner yet."""
    deadline = record.deadline
    if record.is_warm_server:
        owner = {environment.WARM_SERVER: "on"}
        # So much later, because a participant who is assigned the server at the last moment still gets all of
        # maxRuntime, and a session also the time to wait for its members.
        deadline += lifetime_asked_for(project, settings)
    elif record.is_of_session:
        owner = {environment.SESSION: record.user_id}
    else:
        group = environment.group_text(project.group(record.user_id))
        owner = {environment.USER_ID: record.user_id, environment.GROUP: group}
    return {**owner, environment.DEADLINE: str(int(deadline.timestamp()))}


def _plain_environment(project: Project, record: Server, settings: Settings) -> dict[str, str]:
    """The variable with the origins of a front end that needs no token (`plainClients`), if there is such a front end.

    The project and the installation must both allow it. A warm server gets no such variable.
    """
    allowed = project.plain_clients and settings.plain_clients and not record.is_warm_server
    return {environment.PLAIN_ORIGINS: " ".join(project.front_end)} if allowed and project.front_end else {}
