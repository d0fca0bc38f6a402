"""The results of a rehearsal with bots, line by line. Without ids, tokens and addresses, they can be published."""

from __future__ import annotations

import re
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from hippodrome.deployment.core.finding import Finding, Mark

SCHEMA = 1
LINES: Mapping[str, str] = {
    "study": "S3 takes the pages, and Lambda runs the function that registers a study",
    "site": "the address leads to the site, served by API Gateway with a certificate, and it says HSTS",
    "links": "a link without its signature, or with another's, is refused",
    "pages": "participants come by signed links, and the pages take their answers",
    "servers": "servers start, on Fargate Spot or on demand, and get an address, a certificate, and perhaps a name",
    "game": "players get in by their token, see frames, press keys, and come to the end",
    "killed": "a server whose task is killed is replaced, and the game goes on",
    "end": "the stop step ends a server, and nothing of it is left",
    "data": "`deploy data` finds every answer and every recording",
    "timer": "a server that is not stopped is ended by its timer",
    "sweep": "the sweep removes what no server owns",
    "alarm": "an alarm reaches its topic, and its subscribers",
    "times": "the stages take about as long as the simulation assumes",
    "erased": "nothing of the rehearsal is left",
    "cost": "what it cost",
}
"""By the key of a line, what the line proves, in the order of a rehearsal. docs/unproven.md names the keys."""

_PATTERNS = (
    re.compile(r"arn:[\w:/.*~-]+"),
    re.compile(r"\bs[a-z2-7]{20}(-\d+)?\b"),  # servers and their labels
    re.compile(r"\b(bot|rehearsal)-[0-9a-f]{4,}[\w-]*"),
    re.compile(r"\b\d{12}\b"),  # accounts
    re.compile(r"\b\d{1,3}(\.\d{1,3}){3}\b"),
    re.compile(r"(?<=\?)[^\s'\"<>]+"),  # queries of addresses
    re.compile(r"\b[0-9a-f]{16,}\b"),
)
HIDDEN = "…"
LONGEST = 1_000  # characters of a line: parts of it may be an agent's own output


@dataclass(frozen=True)
class TranscriptLine:
    """One line: its key, mark, text and advice, its time (seconds from the beginning), and what was measured."""

    key: str
    mark: Mark
    text: str
    advice: str = ""
    at: float = 0.0
    seconds: Mapping[str, Any] = field(default_factory=dict)


class Transcript:
    """Collects the lines of a rehearsal. `clean` removes secrets from every text first."""

    def __init__(self) -> None:
        self.lines: list[TranscriptLine] = []
        self._began = time.monotonic()
        self._secrets: set[str] = set()

    def hide(self, *secrets: str | None) -> None:
        """Remove these ids, tokens, names and addresses from all later lines. No pattern would find them."""
        self._secrets.update(secret for secret in secrets if secret)

    def clean(self, text: str) -> str:
        """Remove ids, tokens, and anything that reveals the account from the text.

        Control characters are removed, too, since a study's agent may have written a part of the text.
        """
        text = "".join(character if character.isprintable() else " " for character in text)
        for secret in sorted(self._secrets, key=len, reverse=True):
            text = text.replace(secret, HIDDEN)
        for pattern in _PATTERNS:
            text = pattern.sub(HIDDEN, text)
        return text if len(text) <= LONGEST else f"{text[:LONGEST]} {HIDDEN}"

    def say(self, key: str, mark: Mark, text: str, advice: str = "", **seconds: Any) -> None:
        """Add a line with the figures `seconds`. Raises KeyError if its key is not among `LINES`."""
        LINES[key]
        at = round(time.monotonic() - self._began, 1)
        self.lines.append(TranscriptLine(key, mark, self.clean(text), self.clean(advice), at, seconds))

    def good(self, key: str, text: str, **seconds: Any) -> None:
        """Add a line on a result that is good."""
        self.say(key, Mark.GOOD, text, **seconds)

    def bad(self, key: str, text: str, advice: str) -> None:
        """Add a line on a result that is bad, with advice."""
        self.say(key, Mark.BAD, text, advice)

    def has(self, key: str) -> bool:
        """Whether there is a line with this key."""
        return any(line.key == key for line in self.lines)

    @property
    def findings(self) -> list[Finding]:
        """The lines as `doctor` shows them."""
        return [Finding(line.key, line.mark, line.text, line.advice) for line in self.lines]

    @property
    def proven(self) -> list[str]:
        """The keys of proven results: all their lines are good."""
        bad = {line.key for line in self.lines if line.mark is not Mark.GOOD}
        return [key for key in LINES if self.has(key) and key not in bad]

    def document(self, began: datetime, region: str, bots: int) -> dict[str, Any]:
        """Return the transcript as JSON data, for a file."""
        return {
            "schema": SCHEMA,
            "what": "a rehearsal with simulated participants on a real account",
            "began": began.isoformat(timespec="seconds"),
            "region": region,
            "bots": bots,
            "proven": {key: LINES[key] for key in self.proven},
            "lines": [_plain(line) for line in self.lines],
        }


def _plain(line: TranscriptLine) -> dict[str, Any]:
    data: dict[str, Any] = {"key": line.key, "mark": str(line.mark), "text": line.text, "at": line.at}
    if line.advice:
        data["advice"] = line.advice
    if line.seconds:
        data["seconds"] = line.seconds
    return data


def shown(values: Iterable[float]) -> str:
    """Write the range of these seconds in words: `3 s`, or `3 to 8 s`."""
    ordered = sorted(values)
    low, high = ordered[0], ordered[-1]
    return f"{low:.0f} s" if f"{low:.0f}" == f"{high:.0f}" else f"{low:.0f} to {high:.0f} s"
