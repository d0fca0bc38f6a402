"""Looks for what bots sent and played in a folder with a study's data (keys: docs/architecture.md, "Documents")."""

from __future__ import annotations

import json
import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from hippodrome.bots.page import leads_elsewhere, links
from hippodrome.bots.report import BotReport, PlayedStep

MAX_BYTES = 512 * 1024**2  # unpacked; a recording of a few seconds is only larger if the study's agent errs
ANYWHERE = ("presence", "ping")  # kinds of lines of a session that may stand anywhere, also after an episode's end
PIECE = 1024**2  # bytes unpacked at once

_TAPE = re.compile(r"[A-Za-z0-9_-]+-talk-[0-9]{4,}\.json")
"""The name of a piece of a tape of talk, which lies among the recordings (`hippodrome.protocol.keys.tape_key`)."""


@dataclass
class StoredRecording:
    """One recording in the data folder."""

    name: str
    complete: bool = False  # whether it begins with a header and has its end
    step: str = ""  # the step of the study
    steps: int = 0  # the environment's steps
    pictures: int = 0  # the pictures that a browser could show: one for each step and each reset
    counted: bool = False  # whether `Verification` has counted it, for this bot or another of the session


def read_recording(path: Path) -> StoredRecording:
    """Read a recording to its end. Raises nothing: a recording that cannot be read is not complete."""
    recording = StoredRecording(path.name)
    unpack, counts = zlib.decompressobj(31), Counter[str]()
    first, last = None, ("", "")
    try:
        for line in map(json.loads, _lines(path, unpack)):
            kind = str(line["kind"])
            first = first or line
            counts[kind if kind in ("step", "reset") else "other"] += 1
            if kind not in ANYWHERE:
                last = (last[1], kind)
        recording.step = str(first["step"]) if first else ""
        recording.steps = counts["step"]
        recording.pictures = recording.steps + counts["reset"]
        end = last[0] if last[1] == "break" else last[1]  # the break after an episode stands in the episode's file
        recording.complete = unpack.eof and first is not None and first["kind"] == "header" and end == "end"
    except (OSError, zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        recording.complete = False
    return recording


def _lines(path: Path, unpack: Any) -> Iterator[bytes]:
    """The lines of a recording, unpacked piece by piece. Raises ValueError if they are larger than MAX_BYTES."""
    begun, size = bytearray(), 0
    with path.open("rb") as file:
        while not unpack.eof:
            packed = unpack.unconsumed_tail or file.read(PIECE)
            text = unpack.decompress(packed, PIECE)
            if not packed and not text:
                break
            size += len(text)
            if size > MAX_BYTES:
                raise ValueError("it is larger than a recording of a bot's game")
            *whole, rest = text.split(b"\n")
            for line in whole:
                yield bytes(begun + line)
                begun.clear()
            begun += rest
    if begun:
        yield bytes(begun)


@dataclass
class Verification:
    """What was found in the data of what bots sent and played, and what is missing."""

    answers: int = 0  # answers to pages that are stored exactly as the bots sent them
    answers_sent: int = 0
    games: int = 0  # answers of games found
    games_played: int = 0
    recordings: int = 0
    steps: int = 0  # the environments' steps, in the recordings
    codes: int = 0  # final pages that show the stored completion code
    links: int = 0  # final pages without it that have a link to another site
    starts: list[float] = field(default_factory=list)  # seconds from request to ready
    sessions: dict[str, int] = field(default_factory=dict)  # by session id: how many of the bots played in it
    missing: list[str] = field(default_factory=list)


def verify(
    data: Path,
    project_id: str,
    reports: Sequence[BotReport],
    *,
    recorded: bool = True,
    last_error: Callable[[str], str] = lambda _: "",
) -> Verification:
    """Compare a data folder with the bots' reports, and return what was found and what is missing.

    `recorded`: whether the project keeps recordings. `last_error` gets a participant's id, and returns the last error
    in the log of their last server; "" if it is not known.
    """
    verification, read = Verification(), dict[Path, list[StoredRecording]]()
    for report in reports:
        folder = data / project_id / "users" / report.user_id
        membership = document(folder / "session.json")
        session = data / project_id / "sessions" / str(membership["session"]) if membership.get("session") else None
        if session is not None:
            verification.sessions[session.name] = verification.sessions.get(session.name, 0) + 1
        _look_at_answers(verification, report, folder)
        trials = (session or folder) / "trials"
        _look_at_plays(verification, report, folder, _recordings(trials, read), last_error, recorded=recorded)
        for path in sorted(trials.rglob("*")):
            if path.is_file() and path.suffix != ".gz" and not _TAPE.fullmatch(path.name):
                verification.missing.append(f"{report.user_id}: {path.name} lies among the recordings")
        code = membership.get("completionCode") or document(folder / "participant.json").get("completionCode")
        if code and str(code) in report.final_page:
            verification.codes += 1
        elif any(map(leads_elsewhere, links(report.final_page))):
            verification.links += 1
    owners = {report.user_id for report in reports} | verification.sessions.keys()
    for path in sorted((data / "_servers").glob("*.json")):
        record = document(path)
        if record.get("ready") and record.get("userId") in owners:
            verification.starts.append(_seconds(record["requested"], record["ready"]))
    if 0 < verification.codes < sum(report.finished for report in reports) - verification.links:
        verification.missing.append("some final pages lack their completion code, or show another")
    return verification


def _without_marks(answers: Any) -> Any:
    """The answers of a check without what the function adds when it has judged them."""
    if not isinstance(answers, dict) or "passed" not in answers:
        return answers
    return {name: value for name, value in answers.items() if name not in ("passed", "tries")}


def _look_at_answers(verification: Verification, report: BotReport, folder: Path) -> None:
    """Compare the stored answers to pages with the answers that the bot has sent."""
    for step, sent in report.answers.items():
        verification.answers_sent += 1
        stored = document(folder / "answers" / f"{step}.json").get("answers")
        if _same(stored, sent) or _same(_without_marks(stored), sent):
            verification.answers += 1
        else:
            verification.missing.append(f"{report.user_id}: the answers of step {step} are not what was sent")


def _look_at_plays(
    verification: Verification,
    report: BotReport,
    folder: Path,
    recordings: list[StoredRecording],
    last_error: Callable[[str], str],
    *,
    recorded: bool,
) -> None:
    """Compare each game step with its answer and its recordings."""
    for play in report.plays:
        who, stored = f"{report.user_id}, step {play.step}", document(folder / "answers" / f"{play.step}.json")
        answers = stored.get("answers") or {}
        if play.unmatched:
            _look_at_unmatched(verification, who, play, answers)
            continue
        of_step = [recording for recording in recordings if recording.step == play.step]
        _look_at_game(verification, who, play, answers, of_step)
        _look_for_the_cause(verification, who, answers, last_error(report.user_id))
        if recorded and not of_step:
            verification.missing.append(f"{who}: no recording")


def _recordings(trials: Path, read: dict[Path, list[StoredRecording]]) -> list[StoredRecording]:
    """The recordings in this folder. Each is read once, though several bots share the recordings of a session."""
    if trials not in read:
        read[trials] = [read_recording(path) for path in sorted(trials.glob("*/*.gz"))]
    return read[trials]


def _look_at_unmatched(verification: Verification, who: str, play: PlayedStep, answers: dict[str, Any]) -> None:
    """Check that the answer of a game says that its bot was unmatched."""
    verification.games_played += 1
    if answers.get("outcome") == play.outcome:
        verification.games += 1
    else:
        verification.missing.append(f"{who}: the game's answer does not say {play.outcome}")


def _look_at_game(
    verification: Verification, who: str, play: PlayedStep, answers: dict[str, Any], recordings: list[StoredRecording]
) -> None:
    """Compare what a bot has received of a game with its answer and its recordings."""
    verification.games_played += 1
    if not answers:
        verification.missing.append(f"{who}: the game's answer is not there")
        return
    verification.games += 1
    if play.done and (answers.get("score"), answers.get("episodes")) != (play.score, play.episodes):
        verification.missing.append(f"{who}: the score shown is not the score stored")
    if play.lines > answers.get("talk", {}).get("lines", 0):
        verification.missing.append(f"{who}: {play.lines} lines said but not all are counted")
    if not recordings:
        return
    steps, pictures = (
        sum(recording.steps for recording in recordings),
        sum(recording.pictures for recording in recordings),
    )
    uncounted = [
        recording for recording in recordings if not recording.counted
    ]  # the others were counted for another member
    verification.recordings += len(uncounted)
    verification.steps += sum(one.steps for one in uncounted)
    verification.missing += [f"{who}: {one.name} is cut off" for one in uncounted if not one.complete]
    for one in uncounted:
        one.counted = True
    if steps < answers.get("frames", 0):
        verification.missing.append(f"{who}: {steps} steps recorded of {answers.get('frames')} played")
    if pictures < play.frames:
        verification.missing.append(f"{who}: {play.frames} frames seen but {pictures} recorded")


def _look_for_the_cause(verification: Verification, who: str, answers: dict[str, Any], error: str) -> None:
    """Add the last error in the server's log to `missing`, if the game failed or has no answer."""
    if answers.get("outcome") == "failed":
        verification.missing.append(
            f"{who}: the game ended with an error of the agent's{f': {error}' if error else ''}"
        )
    elif not answers and error:
        verification.missing.append(f"{who}: its server said last: {error}")


def _same(stored: object, sent: object) -> bool:
    """Whether both hold the same names in the same order with the same texts."""
    return json.dumps(stored).encode() == json.dumps(sent).encode()


def _seconds(before: str, after: str) -> float:
    return (datetime.fromisoformat(after) - datetime.fromisoformat(before)).total_seconds()


def document(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; {} if there is no such file, or no object in it."""
    try:
        data = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return data if isinstance(data, dict) else {}
