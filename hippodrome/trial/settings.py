"""The settings of a trial server: its environment variables (`protocol/environment.py`), and the section `trial`."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from hippodrome.protocol import environment as variables
from hippodrome.protocol.keys import NAME, SERVER_NAME, recordings_folder, session_recordings_folder
from hippodrome.protocol.session import Member, is_session_id
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.trial_check import check
from hippodrome.protocol.values import path_text

DEFAULT_GAME = "ALE/MsPacman-v5"
"""The game of a server that is started by hand and whose settings name none. A registered study always names one."""

STEP_SECONDS = 30.0
"""Seconds in which the agent must take a step or begin an episode, and draw it. `check` waits no longer either."""

STALLED_SECONDS = 3.0
"""A client that acknowledges frames counts as lost or hidden if it leaves one without acknowledgement for so long."""


class SettingsError(ValueError):
    """The environment or the section `trial` cannot be used. The message names the key and says what is wrong."""


def trial_section(section: Mapping[str, Any]) -> TrialSection:
    """Check the section `trial`, and return it with a game and with actions' names in lower case.

    Unknown keys are ignored. Raises SettingsError with the first problem.
    """
    found, problems = check(dict(section))
    for path, sentence, _ in problems:
        raise SettingsError(f"{path_text(('trial', *path))}: {sentence}")
    names = tuple(name.lower() for name in found.action_space)
    return replace(found, game=found.game or DEFAULT_GAME, action_space=names)


@dataclass(frozen=True, slots=True)
class TrialSettings:
    """The settings of one trial server. Most fields are variables of `protocol/environment.py`, which explains them.

    Durations are seconds; `deadline` is in seconds since the epoch. A warm server without a participant has no
    `user_id` and no `group`, and `server` is its own name. The server of a session has no `user_id`; its `group` is the
    session's.
    """

    project_id: str
    user_id: str
    server: str
    token: str = field(repr=False)
    game_steps: tuple[str, ...]
    store: str
    trial: TrialSection
    group: int | None = None
    warm_server: bool = False
    session: str = ""
    """The id of the session whose members play here; empty if one participant plays."""
    players: int = 1
    """The number of seats for participants."""
    members: tuple[Member, ...] = ()
    """The session's members, from its document. Empty until the document was read, and if one participant plays."""
    condition: Mapping[str, str] = field(default_factory=dict)
    """The levels of the factors between people; empty before they are known."""
    levels: Mapping[str, Any] = field(default_factory=dict)
    """Of a trial: the levels of the factors within people, and the `position` of this run; empty outside of blocks."""
    answers: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Of a trial: the keys of the answers to earlier steps that the agent gets, as in `protocol.assignment.Game`."""
    has_assignment: bool = False
    """Whether an assignment says which games are played here (`protocol/assignment.py`)."""
    match: bool = False
    """The function `match` of agent.py decides who plays with whom, and this server calls it."""
    host: str = "0.0.0.0"  # noqa: S104 - the container's only purpose is to be reached
    port: int = 5000
    tls: bool = True
    ssl_fullchain: str = ""
    ssl_privkey: str = ""
    deadline: float | None = None
    idle_seconds: float = 600.0
    grace_seconds: float = 60.0
    agent_dir: Path = Path(".")
    spool: Path | None = None
    start_seconds: float = 300.0
    step_seconds: float = STEP_SECONDS
    hello_seconds: float = 10.0
    stalled_seconds: float = STALLED_SECONDS
    linger_seconds: float = 2.0
    recordings_first_seconds: float = 120.0
    stop_seconds: float = 30.0
    credential: str = field(default="", repr=False)
    llm_key: str = field(default="", repr=False)
    """The key of the language model; empty if it needs none, or on a server without one."""
    llm_url: str = ""
    """The address of a stand-in for the language model; empty for `trial.llm.url`."""
    warm_server_seconds: float = 20.0
    plain_origins: frozenset[str] = frozenset()
    """The origins whose pages need no token (plainClients)."""

    @property
    def assigned(self) -> bool:
        """Whether the server knows who plays here.

        A warm server and a session's server without members learn it later.
        """
        return not self.warm_server and (not self.session or bool(self.members))

    @property
    def asks_model(self) -> bool:
        """Whether some game of the study may ask a language model."""
        return self.trial.llm is not None or (self.has_assignment and bool(self.llm_key or self.llm_url))

    @property
    def seats(self) -> Mapping[str, int]:
        """The seat of each member of the session, by their id; empty if one participant plays.

        `trial.substitute` plays in each of the `players` seats that no member has.
        """
        return {member.user_id: member.seat for member in self.members if member.user_id}

    @property
    def private(self) -> tuple[str, ...]:
        """The ids of the participants who play here. No log may contain them."""
        return tuple(self.seats) if self.session else (self.user_id,)

    @property
    def recordings_folder(self) -> str:
        """The folder of this server's recordings, without a slash at its end."""
        if self.session:
            return session_recordings_folder(self.project_id, self.session) + self.server
        return recordings_folder(self.project_id, self.user_id) + self.server

    @classmethod
    def from_env(cls, env: Mapping[str, str]) -> TrialSettings:
        """Read the environment of a trial server. Raises SettingsError naming the variable that is wrong."""
        steps = tuple(part.strip() for part in _required(env, variables.GAME_STEPS).split(",") if part.strip())
        if not steps or not all(NAME.fullmatch(step) for step in steps):
            raise SettingsError("GAME_STEPS must be step keys separated by commas, such as 3 or 2,4")
        tls, warm_server = _switch(env, variables.TLS, True), _switch(env, variables.WARM_SERVER, False)
        if tls and not env.get(variables.CERTIFICATE):
            _required(env, variables.SSL_FULLCHAIN)
            _required(env, variables.SSL_PRIVKEY)
        port = _number(env, variables.PORT, 5000)
        if not (port.is_integer() and 0 <= port <= 65535):
            raise SettingsError("PORT must be a whole number from 0 to 65535")
        session = "" if warm_server else env.get(variables.SESSION, "").strip()
        if session and not is_session_id(session):
            raise SettingsError("SESSION is not the id of a session")
        origins = env.get(variables.PLAIN_ORIGINS, "").split()
        agent_dir, store = Path(env.get(variables.AGENT_DIR) or ".").resolve(), _required(env, variables.STORE)
        if "://" in store and not store.startswith(("https://", "http://")):
            raise SettingsError("STORE must be a folder, or the address that signs requests (https://…)")
        return cls(
            project_id=_name(env, variables.PROJECT_ID, NAME),
            user_id="" if warm_server or session else _name(env, variables.USER_ID, NAME),
            server=_name(env, variables.SERVER, SERVER_NAME),
            token=_required(env, variables.TOKEN),
            game_steps=steps,
            store=store,
            trial=_trial_of(env),
            group=None if warm_server or session else _group(env.get(variables.GROUP, "").strip()),
            warm_server=warm_server,
            session=session,
            has_assignment=_switch(env, variables.ASSIGNMENT, False),
            match=env.get(variables.MATCHING, "").strip() == "match",
            host=env.get(variables.HOST) or "0.0.0.0",  # noqa: S104
            port=int(port),
            tls=tls,
            ssl_fullchain=env.get(variables.SSL_FULLCHAIN, ""),
            ssl_privkey=env.get(variables.SSL_PRIVKEY, ""),
            deadline=_number(env, variables.DEADLINE, 0.0) or None,
            idle_seconds=_number(env, variables.IDLE_SECONDS, 600.0),
            grace_seconds=_number(env, variables.GRACE_SECONDS, 60.0),
            agent_dir=agent_dir,
            spool=Path(env[variables.SPOOL]).resolve() if env.get(variables.SPOOL) else None,
            start_seconds=_number(env, variables.START_SECONDS, 300.0),
            step_seconds=_number(env, variables.STEP_SECONDS, STEP_SECONDS),
            hello_seconds=_number(env, variables.HELLO_SECONDS, 10.0),
            stalled_seconds=_number(env, variables.STALLED_SECONDS, STALLED_SECONDS),
            linger_seconds=_number(env, variables.LINGER_SECONDS, 2.0),
            recordings_first_seconds=_number(env, variables.RECORDINGS_FIRST_SECONDS, 120.0),
            stop_seconds=max(15.0, _number(env, variables.STOP_SECONDS, 30.0)),
            warm_server_seconds=_number(env, variables.ASSIGNMENT_SECONDS, 20.0),
            plain_origins=frozenset() if warm_server or session else frozenset(origins),
            llm_key=env.get(variables.LLM_KEY, "").strip(),
            llm_url=env.get(variables.LLM_URL, "").strip(),
            credential=_required(env, variables.CREDENTIAL) if "://" in store else "",
        )


def _trial_of(env: Mapping[str, str]) -> TrialSection:
    text = env.get(variables.TRIAL, "")
    if text.strip():
        try:
            section = json.loads(text)
        except ValueError as error:
            raise SettingsError("TRIAL is not JSON") from error
        if not isinstance(section, dict):
            raise SettingsError("TRIAL must be a JSON object")
        return trial_section(section)
    path = Path("config.yml")
    if not path.is_file():
        return trial_section({})
    import yaml  # noqa: PLC0415 - a server started by the control plane has TRIAL

    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise SettingsError("config.yml is not YAML") from error
    section = document.get("trial") if isinstance(document, dict) else None
    if section is not None and not isinstance(section, dict):
        raise SettingsError("trial in config.yml must be a mapping")
    return trial_section(section or {})


def _required(env: Mapping[str, str], key: str) -> str:
    value = env.get(key, "").strip()
    if not value:
        raise SettingsError(f"{key} is not set")
    return value


def _switch(env: Mapping[str, str], key: str, default: bool) -> bool:
    value = env.get(key, "").strip().lower()
    if value not in ("", "on", "off"):
        raise SettingsError(f"{key} must be 'on' or 'off'")
    return value == "on" if value else default


def _group(text: str) -> int | None:
    if text and not (text.isascii() and text.isdecimal()):
        raise SettingsError("GROUP must be a whole number, or empty")
    return int(text) if text else None


def _name(env: Mapping[str, str], key: str, pattern: re.Pattern[str]) -> str:
    value = _required(env, key)
    if not pattern.fullmatch(value):
        raise SettingsError(f"{key} must have the form {pattern.pattern}")
    return value


def _number(env: Mapping[str, str], key: str, default: float) -> float:
    text = env.get(key, "").strip()
    if not text:
        return float(default)
    try:
        value = float(text)
    except ValueError as error:
        raise SettingsError(f"{key} must be a number") from error
    if not math.isfinite(value) or value < 0:
        raise SettingsError(f"{key} must be a number of zero or more")
    return value
