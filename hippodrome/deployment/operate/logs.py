"""`deploy logs`: shows what functions and servers have logged, in the order of time."""

from __future__ import annotations

import heapq
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any

import typer
from botocore.exceptions import ClientError
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors as aws_errors
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.core import options, participants
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.core.study_selection import one_or_all
from hippodrome.deployment.operate.log_lines import TRIAL, LogLine, moment, read

POLL = 5  # seconds between two looks; an account may call FilterLogEvents 5 times a second in most regions
OVERLAP = timedelta(seconds=60)  # events may arrive this late, so each look goes back so far
STYLES = {"ERROR": "red", "CRITICAL": "bold red", "WARNING": "yellow", "DEBUG": "dim"}


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
            yield f"{source}/{_id_of(event)}", read(event, source)

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


def _id_of(event: Mapping[str, Any]) -> str:
    """Return the event's id: AWS's own, or its time, stream and message, since emulators give no ids."""
    return str(event.get("eventId") or [event.get(key) for key in ("timestamp", "logStreamName", "message")])


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
    look: Callable[[datetime], Iterable[tuple[str, LogLine]]],
    since: datetime,
    show: Callable[[LogLine], None],
    *,
    sleep: Callable[[float], None] = time.sleep,
    rounds: int | None = None,
) -> None:
    """Call `show` with each new line once, also with late ones, until Ctrl-C or for `rounds` looks."""
    seen: dict[str, datetime] = {}
    latest = since
    while rounds is None or rounds > 0:
        for event_id, line in look(max(since, latest - OVERLAP)):
            if event_id not in seen:
                seen[event_id] = line.time
                latest = max(latest, line.time)
                show(line)
        seen = {event_id: when for event_id, when in seen.items() if when >= latest - OVERLAP}
        rounds = None if rounds is None else rounds - 1
        if rounds != 0:
            sleep(POLL)


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
