"""Prints the report of a rehearsal: a table, and what went wrong."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from statistics import median

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from hippodrome.bots.report import BotReport, PlayedStep
from hippodrome.bots.verification import Verification
from hippodrome.local.rehearsal.logs import AgentCrash
from hippodrome.local.rehearsal.study_process import Leftovers

EARLY = ("left", "partnerLeft", "ping")  # outcomes of games that ended early
SHOWN_LINES = 10  # the most lines of each kind
SHOWN_NAMES = 3  # the most names of bots that found no others
SHOWN_CRASHES = 3  # the most tracebacks of agent.py


def report(
    console: Console,
    reports: Sequence[BotReport],
    verification: Verification | None,
    leftovers: Leftovers | None,
    seconds: float,
    *,
    play: float,
    recorded: bool = True,
    live: bool = True,
    warnings: Sequence[str] = (),
    crashes: Sequence[AgentCrash] = (),
) -> bool:
    """Print the table and what went wrong; return whether everything is as it should be.

    `play`: after how many seconds a bot stops its game; 0: never. `recorded`: whether the study keeps recordings.
    `live`: whether participants get in. `warnings` come from the functions' log; `crashes` are the errors of agent.py.
    `verification` is None if the folder of the data is not known, and `leftovers` if nobody looked for servers that are
    left over.
    """
    table = Table(show_header=False, title=_title(reports, seconds), title_justify="left")
    for name, value in [
        *_played(reports, verification, play),
        *_found(reports, verification, recorded=recorded, live=live),
        *([("servers left over", str(max(leftovers.processes, len(leftovers.records))))] if leftovers else []),
    ]:
        table.add_row(name, value)
    errors = [f"{bot.user_id}: {error}" for bot in reports for error in bot.errors]
    troubles = [f"{bot.user_id}: {trouble}" for bot in reports for trouble in bot.troubles]
    if troubles:
        table.add_row("troubles got over", str(len(troubles)))
    if not any(bot.finished or bot.end for bot in reports) and not errors:
        errors = ["no bot came to the last page"]
    bad = errors + (verification.missing if verification else []) + (leftovers.words() if leftovers else [])
    failures = [crash.words() for crash in crashes]
    table.add_row("errors", escape("\n".join([*([str(len(bad))] if bad else []), *failures])) or "none")
    console.print(table)
    for crash in crashes[:SHOWN_CRASHES]:
        console.print(escape(crash.traceback), style="red", soft_wrap=True)
    _print(console, troubles, "yellow")
    _print(console, bad, "red")
    if warnings:
        console.print("  Local mode said:")
    _print(console, warnings, "red" if bad else "yellow")
    return not bad and not crashes


Rows = list[tuple[str, str]]


def _title(reports: Sequence[BotReport], seconds: float) -> str:
    return f"Rehearsal with {len(reports)} bot{'s' if len(reports) != 1 else ''}, {seconds:.0f} s"


def _played(reports: Sequence[BotReport], verification: Verification | None, play: float) -> Rows:
    """The rows of what the bots have seen."""
    plays = [play for bot in reports for play in bot.plays]
    rows = [("bots finished", _of(sum(bot.finished for bot in reports), len(reports)))]
    for step, count in sorted(Counter(bot.ended for bot in reports if bot.ended).items()):
        rows.append(("ended before", f"{count} at step {step}, whose page had no button for them to press"))
    ends = Counter(bot.end for bot in reports if bot.end)
    if ends:
        rows.append(("other ends reached", ", ".join(f"{end} {count}" for end, count in sorted(ends.items()))))
    rows += _together(reports)
    games = _games(reports)
    if stopped := sum(any(each.stopped for each in game) for game in games):
        rows.append(
            ("games stopped early", f"{_of(stopped, len(games))}: a bot plays {play:g} s (`--play 0`: to the end)")
        )
    if plays:
        rows.append(("wait on the game page", _spread([play.waited for play in plays])))
    if verification and verification.starts:
        rows.append(("server: request to ready", _spread(verification.starts)))
    rates = [rate for play in plays if (rate := play.received_rate)]
    if rates:
        frame_rates = ", ".join(sorted({str(play.frame_rate) for play in plays if play.frame_rate}))
        amount = sum(play.bytes for play in plays)
        rows.append(("frames per second", f"p50 {median(rates):.1f}, least {min(rates):.1f}, of {frame_rates} set"))
        if any(play.lines for play in plays):
            rows.append(("lines said", str(sum(play.lines for play in plays))))
        rows.append(("frames received", f"{sum(play.frames for play in plays)}, {amount / 1e6:.1f} MB"))
    return rows


def _games(reports: Sequence[BotReport]) -> list[list[PlayedStep]]:
    """The games that were played; each as the bots who played in it have seen it."""
    games: dict[tuple[str, str], list[PlayedStep]] = {}
    for bot in reports:
        for play in bot.plays:
            if not play.unmatched and play.addresses:
                together = play.members > 1
                games.setdefault((play.step, play.addresses[0] if together else bot.user_id), []).append(play)
    return [*games.values()]


def _together(reports: Sequence[BotReport]) -> Rows:
    """The rows of games that bots played together; none if no bot played or waited with others."""
    plays = [play for bot in reports for play in bot.plays]
    waited = [play.lobby for play in plays if play.lobby is not None]
    if not waited and not any(play.unmatched or play.members > 1 for play in plays):
        return []
    sizes = Counter(game[0].members for game in _games(reports))
    sentence = " and ".join(
        f"{count} with {size} participant{'' if size == 1 else 's'}"
        for size, count in sorted(sizes.items(), reverse=True)
    )
    early = Counter(play.outcome for play in plays if play.outcome in EARLY)
    ended = ", ".join(f"{count} {outcome}" for outcome, count in sorted(early.items()))
    alone = [bot.user_id for bot in reports if any(play.unmatched for play in bot.plays)]
    names = ", ".join(alone[:SHOWN_NAMES]) + (" …" if len(alone) > SHOWN_NAMES else "")
    return [
        ("games played together", sentence or "none"),
        *([("wait in the lobby", _spread(waited))] if waited else []),
        ("unmatched", f"{len(alone)}: {names}" if alone else "0"),
        *([("ended early", ended)] if ended else []),
    ]


def _found(reports: Sequence[BotReport], verification: Verification | None, *, recorded: bool, live: bool) -> Rows:
    """The rows of what is in the data."""
    if not verification:
        return [("data", "not looked at: --data says where they are")]
    unrecorded = "none expected: config.yml says `s3upload: false`"
    closed = "none expected: config.yml says `live: false`, so no participant gets in"
    finished = sum(bot.finished for bot in reports)
    recordings = f"{verification.recordings}, with {verification.steps} steps"
    return [
        ("answers found", _of(verification.answers, verification.answers_sent)),
        ("games found", _of(verification.games, verification.games_played)),
        ("recordings", recordings if recorded or verification.recordings else unrecorded),
        ("codes or links back shown", _of(verification.codes + verification.links, finished) if live else closed),
    ]


def _print(console: Console, all_lines: Sequence[str], style: str) -> None:
    lines = _counted(all_lines)
    for line in lines[:SHOWN_LINES]:
        console.print(f"  {escape(line)}", style=style, soft_wrap=True)
    if len(lines) > SHOWN_LINES:
        console.print(f"  … and {len(lines) - SHOWN_LINES} more", style=style)


def _counted(lines: Sequence[str]) -> list[str]:
    """Each line once. Of lines that differ only in the bot that they begin with, the first one, and their number."""
    groups: dict[str, list[str]] = {}
    for line in lines:
        groups.setdefault(re.sub(r"^bot-\w+-\d+", "", line), []).append(line)
    return [same[0] if len(same) == 1 else f"{len(same)} times: {same[0]}" for same in groups.values()]


def _of(part: int, whole: int) -> str:
    return f"{part} of {whole}"


def _spread(values: Sequence[float]) -> str:
    """The median, the 95th percentile and the maximum of seconds."""
    ordered = sorted(values)
    p95 = ordered[round(0.95 * (len(ordered) - 1) + 0.49)]
    return f"p50 {median(ordered):.1f} s, p95 {p95:.1f} s, max {ordered[-1]:.1f} s"
