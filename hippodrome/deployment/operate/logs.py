"""`hippodrome logs`: shows what functions and servers have logged, in the order of time."""

from __future__ import annotations

import heapq
import json
import re
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import typer
from botocore.exceptions import ClientError
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors as aws_errors
from hippodrome.control.model import ids
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.core import options, participants
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.core.study_selection import one_or_all

TRIAL = "trial"  # the log group of the servers
POLL = 5  # seconds between two looks; an account may call FilterLogEvents 5 times a second in most regions
OVERLAP = timedelta(seconds=60)  # events may arrive this late, so each look goes back so far
ERRORS = {"ERROR", "CRITICAL", "FATAL"}
STYLES = {"ERROR": "red", "CRITICAL": "bold red", "WARNING": "yellow", "DEBUG": "dim"}

_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_AGO = re.compile(r"(\d{1,4})\s*([smhdw])")
_PLATFORM_TEXT = re.compile(r"(INIT_START|START|END|REPORT)\b")
_FATAL_TEXT = re.compile(
    r"Task timed out after|Runtime exited|Process exited before|\[ERROR\]|Runtime\.\w+Error|\bstatus: (error|timeout)",
    re.IGNORECASE,
)
# The beginning of a line of `logging` or of Lambda's text format, and the message after it.
_TEXT = re.compile(
    r"(?:\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d\S*\s+)?\[?(DEBUG|INFO|WARNING|WARN|ERROR|CRITICAL|FATAL)\]?[\s:]+(.*)",
    re.DOTALL,
)
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_OF_EVERY_LINE = {"level", "message", "timestamp", "service", "location", "function_name", "function_arn", "cold_start"}
_LEFT_OUT = _OF_EVERY_LINE | {"function_memory_size", "function_request_id", "xray_trace_id", "_aws"}


@dataclass(frozen=True)
class LogLine:
    """A log event: its time, its source (a function, or `trial`), its level, its message and further fields."""

    time: datetime
    source: str
    level: str  # "" if the event has none
    message: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    platform: bool = False  # Lambda's own START, END and REPORT without an error, or metrics
    stream: str = ""

    @property
    def is_error(self) -> bool:
        return self.level in ERRORS

    @property
    def server(self) -> str | None:
        """The label of the server that the line is about, if it names one."""
        for name in (self.fields.get("server"), self.fields.get("name")):
            parsed = ids.parse_server_name(name) if isinstance(name, str) else None
            if parsed:
                return parsed[0]
        return None

    def as_text(self) -> str:
        """Write the line for a terminal, in local time."""
        more = _printable(" ".join(f"{name}={_short(value)}" for name, value in self.fields.items()))
        level = f"{self.level:<7} " if self.level else ""
        message = _printable(self.message.rstrip("\n")).replace("\n", "\n    ")
        return f"{self.time.astimezone():%m-%d %H:%M:%S} {self.source:<14} {level}{message}{'  ' if more else ''}{more}"

    def as_json(self) -> dict[str, Any]:
        """Return the line as JSON data, for scripts."""
        return {
            "time": self.time.isoformat(),
            "source": self.source,
            "level": self.level,
            "message": self.message,
            **({"fields": dict(self.fields)} if self.fields else {}),
        }


def read(event: Mapping[str, Any], source: str) -> LogLine:
    """Read an event from FilterLogEvents, in any format that Hippodrome's log groups contain."""
    time = datetime.fromtimestamp(int(event["timestamp"]) / 1000, UTC)
    text = str(event.get("message", ""))
    stream = str(event.get("logStreamName", ""))
    try:
        entry = json.loads(text)
    except (ValueError, RecursionError):
        entry = None
    if isinstance(entry, dict):
        return _of_json(entry, time, source, stream)
    return _of_text(text, time, source, stream)


def _of_json(entry: dict[str, Any], time: datetime, source: str, stream: str) -> LogLine:
    if "routeKey" in entry or "httpMethod" in entry:  # an access log of the HTTP API
        status = str(entry.get("status", ""))
        level = "ERROR" if status.startswith("5") else "INFO"
        method = entry.get("httpMethod") or entry.get("routeKey")
        rest = {key: value for key, value in entry.items() if key not in ("httpMethod", "routeKey", "status")}
        return LogLine(time, source, level, f"{status} {method}", rest, stream=stream)
    fields = {key: value for key, value in entry.items() if key not in _LEFT_OUT and value is not None}
    if "_aws" in entry and "message" not in entry:  # metrics (CloudWatch's embedded metric format)
        return LogLine(time, source, "", "metrics", fields, platform=True, stream=stream)
    message = entry.get("message", "")
    text = message if isinstance(message, str) else json.dumps(message, ensure_ascii=False)
    return LogLine(time, source, str(entry.get("level", "")).upper(), text, fields, stream=stream)


def _of_text(text: str, time: datetime, source: str, stream: str) -> LogLine:
    if _FATAL_TEXT.search(text):
        return LogLine(time, source, "ERROR", text.strip(), stream=stream)
    if _PLATFORM_TEXT.match(text) and source != TRIAL:
        return LogLine(time, source, "", text.strip(), platform=True, stream=stream)
    match = _TEXT.match(text)
    if match:
        level = {"WARN": "WARNING", "FATAL": "CRITICAL"}.get(match[1], match[1])
        return LogLine(time, source, level, match[2].rstrip("\n"), stream=stream)
    return LogLine(time, source, "", text.rstrip("\n"), stream=stream)


def moment(text: str, now: datetime) -> datetime:
    """Read `--since`: `90m` ago, or an ISO date or time, in UTC if it has no zone. Raises ValueError."""
    if ago := _AGO.fullmatch(text.strip()):
        return now - timedelta(**{_UNITS[ago[2]]: int(ago[1])})
    parsed = datetime.fromisoformat(text.strip())
    return parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)


def _printable(text: str) -> str:
    """Replace control characters in the text by �."""
    return _CONTROL.sub("�", text)


def _short(value: object) -> str:
    if isinstance(value, str) and re.fullmatch(r"[\w.:/@+-]+", value):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)


class Reader:
    """Reads the log groups of an installation, merged by time."""

    def __init__(self, client: Any, stack: str) -> None:
        self._client = client
        self._stack = stack

    def sources(self) -> list[str]:
        """Return the sources of all log groups: functions, `trial`, and other parts of the stack.

        Credentials that may not list groups (a researcher's) get the functions in the template, and `trial`.
        """
        groups = self._client.get_paginator("describe_log_groups")
        try:
            log_sources = [
                resource_names.log_source(self._stack, group["logGroupName"])
                for prefix in resource_names.log_prefixes(self._stack)
                for page in groups.paginate(logGroupNamePrefix=prefix)
                for group in page["logGroups"]
            ]
        except ClientError as error:
            if aws_errors.code(error) != "AccessDeniedException":
                raise
            return sorted([*Template.read().functions, TRIAL])
        return sorted(log_sources)

    def events(
        self, sources: Iterable[str], since: datetime, project_id: str | None = None
    ) -> Iterator[tuple[str, LogLine]]:
        """Yield every line since this time, in the order of time. Reads the groups page by page.

        With each line comes its event's id, by which `follow` recognises new events.
        """
        streams = [self._events(source, since, project_id) for source in sources]
        for _, _, event, source in heapq.merge(*streams, key=lambda stream: stream[:2]):
            yield f"{source}/{event.get('eventId')}", read(event, source)

    def _events(
        self, source: str, since: datetime, project_id: str | None
    ) -> Iterator[tuple[int, int, Mapping[str, Any], str]]:
        # AWS interleaves streams in any case since 2019, emulators only with `interleaved`.
        # The name of a server's log stream begins with its project's id (awslogs-stream-prefix).
        narrowed = {"logStreamNamePrefix": f"{project_id}/"} if project_id and source == TRIAL else {}
        pages = self._client.get_paginator("filter_log_events").paginate(
            logGroupName=resource_names.log_group(self._stack, source),
            startTime=int(since.timestamp() * 1000),
            interleaved=True,
            **narrowed,
        )
        try:
            for page in pages:
                for number, event in enumerate(page["events"]):
                    yield event["timestamp"], number, event, source
        except ClientError as error:
            if aws_errors.code(error) != "ResourceNotFoundException":  # deleted after it was listed
                raise


class LineFilter:
    """Decides which lines are shown."""

    def __init__(
        self, errors: bool, everything: bool, project_id: str | None, owner: Callable[[str], str | None]
    ) -> None:
        self._errors = errors
        self._everything = everything
        self._project_id = project_id
        self._owner = owner  # server's label → its project's id
        self._last: dict[str, bool] = {}  # log stream → whether its last line with a level was an error

    def __call__(self, line: LogLine) -> bool:
        where = f"{line.source}/{line.stream}"
        if line.level:
            self._last[where] = line.is_error
        # Each line of a traceback of a trial is an event, of which only the first has a level.
        bad = line.is_error or (not line.level and line.source == TRIAL and self._last.get(where, False))
        if self._errors and not bad:
            return False
        if line.platform and not self._everything:
            return False
        if self._project_id is None:
            return True
        if line.source == TRIAL:
            return line.stream.startswith(f"{self._project_id}/")
        return line.server is not None and self._owner(line.server) == self._project_id


def follow(
    look: Callable[[datetime], Iterable[tuple[str, LogLine]]], since: datetime, show: Callable[[LogLine], None]
) -> None:
    """Call `show` with each new line once, also with late ones, until Ctrl-C."""
    seen: dict[str, datetime] = {}
    latest = since
    while True:
        for event_id, line in look(max(since, latest - OVERLAP)):
            if event_id not in seen:
                seen[event_id] = line.time
                latest = max(latest, line.time)
                show(line)
        seen = {event_id: when for event_id, when in seen.items() if when >= latest - OVERLAP}
        time.sleep(POLL)


def command(
    study: options.Study = None,
    *,
    function: Annotated[
        str | None,
        typer.Option(
            "--function",
            help="Only this function, such as start_server, or `trial` for the servers.",
            show_default=False,
        ),
    ] = None,
    every: options.All = False,
    since: Annotated[str, typer.Option("--since", help="How far back: 90s, 30m, 1h, 2d, or a time (UTC).")] = "1h",
    following: Annotated[bool, typer.Option("--follow", "-f", help="Go on and show new lines until Ctrl-C.")] = False,
    errors: Annotated[bool, typer.Option("--errors", help="Only errors.")] = False,
    everything: Annotated[
        bool, typer.Option("--everything", help="Also Lambda's START, END and REPORT, and metrics.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object a line, for scripts.")] = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Show what functions and servers have logged, in the order of time.

    No line has a participant's id or an answer; servers have their names, which are hashes. Of a study, there are only
    lines of its servers, and of functions about its servers; --all shows every line of functions.
    """
    try:
        start = moment(since, datetime.now(UTC))
    except ValueError:
        raise Problem(f"--since {since} is no time.", "Write 90s, 30m, 1h, 2d, or 2026-11-21T09:30.") from None
    project = one_or_all(study, every)
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    reader = Reader(account.client("logs"), stack)
    known = reader.sources()
    if function is not None and function not in known:
        raise Problem(f"Nothing named {function} logs here.", f"There is: {', '.join(known) or 'no log group yet'}.")
    sources = [function] if function else known
    documents = account.platform(installation).documents
    if project:
        participants.choose(participants.registered_projects(documents), project)

    owners: dict[str, str | None] = {}

    def owner(label: str) -> str | None:
        if label not in owners:
            record = Records(documents).read([label]).get(label)
            owners[label] = record.project_id if record else None
        return owners[label]

    chosen = LineFilter(errors, everything, project, owner)

    shown = 0

    def show(line: LogLine) -> None:
        nonlocal shown
        if not chosen(line):
            return
        shown += 1
        if as_json:
            sys.stdout.write(json.dumps(line.as_json(), ensure_ascii=False, default=str) + "\n")
        else:
            screen.out.print(Text(line.as_text(), style=STYLES.get(line.level, "")))
        if following:
            sys.stdout.flush()

    try:
        if following:
            follow(lambda moment: reader.events(sources, moment, project), start, show)
        else:
            for _, line in reader.events(sources, start, project):
                show(line)
            if not shown:
                what = "No errors were" if errors else "Nothing was"
                screen.info(f"{what} logged since {start.astimezone():%Y-%m-%d %H:%M}; --since 2d looks further back.")
    except KeyboardInterrupt:
        if not following:
            raise
    except BrokenPipeError:  # `| head`
        sys.stderr.close()
    return Exit.DONE
