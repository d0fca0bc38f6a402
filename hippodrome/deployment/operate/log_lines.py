"""Turns log events of functions and trials into lines for people and scripts. Pure."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from hippodrome.control.model import ids

ERRORS = {"ERROR", "CRITICAL", "FATAL"}
TRIAL = "trial"  # the log group of the servers
_UNITS = {"s": "seconds", "m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_AGO = re.compile(r"(\d{1,6})\s*([smhdw])")
_PLATFORM_TEXT = re.compile(r"(INIT_START|START|END|REPORT|RESTORE_START|EXTENSION)\b")
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
_LEFT_OUT = {
    "level",
    "message",
    "timestamp",
    "time",
    "service",
    "location",
    "function_name",
    "function_arn",
    "cold_start",
    "function_memory_size",
    "function_request_id",
    "requestId",
    "xray_trace_id",
    "type",
}


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
    kind = str(entry.get("type", ""))
    if kind.startswith("platform.") and isinstance(entry.get("record"), dict):
        event, status = kind.removeprefix("platform."), str(entry["record"].get("status", "success"))
        if status == "success":
            return LogLine(time, source, "", event, platform=True, stream=stream)
        shown = {key: value for key, value in entry["record"].items() if key in ("status", "errorType", "metrics")}
        return LogLine(time, source, "ERROR", f"{event}: {status}", shown, stream=stream)
    if "errorType" in entry and "message" not in entry:  # an exception that left the function
        fields = {key: value for key, value in entry.items() if key in ("errorType", "stackTrace", "requestId")}
        return LogLine(time, source, "ERROR", "unhandled exception", fields, stream=stream)
    if "routeKey" in entry or "httpMethod" in entry:  # an access log of the HTTP API
        status = str(entry.get("status", ""))
        level = "ERROR" if status.startswith("5") else "INFO"
        method = entry.get("httpMethod") or entry.get("routeKey")
        rest = {key: value for key, value in entry.items() if key not in ("httpMethod", "routeKey", "status")}
        return LogLine(time, source, level, f"{status} {method}", rest, stream=stream)
    if "_aws" in entry and "message" not in entry:  # metrics (CloudWatch's embedded metric format)
        fields = {key: value for key, value in entry.items() if key not in _LEFT_OUT | {"_aws"}}
        return LogLine(time, source, "", "metrics", fields, platform=True, stream=stream)
    level = str(entry.get("level", "")).upper()
    message = entry.get("message", "")
    fields = {key: value for key, value in entry.items() if key not in _LEFT_OUT and value is not None}
    text = message if isinstance(message, str) else json.dumps(message, ensure_ascii=False)
    return LogLine(time, source, level, text, fields, stream=stream)


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
    ago = _AGO.fullmatch(text.strip())
    if ago:
        try:
            return now - timedelta(**{_UNITS[ago[2]]: int(ago[1])})
        except OverflowError:
            raise ValueError(text) from None
    parsed = datetime.fromisoformat(text.strip())
    return parsed if parsed.tzinfo else parsed.replace(tzinfo=UTC)


def _printable(text: str) -> str:
    """Replace control characters in the text by �."""
    return _CONTROL.sub("�", text)


def _short(value: object) -> str:
    if isinstance(value, str) and re.fullmatch(r"[\w.:/@+-]+", value):
        return value
    return json.dumps(value, ensure_ascii=False, default=str)
