"""The results of a rehearsal with bots, line by line. Without ids, tokens and addresses, they can be published."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Any

from hippodrome.console.problem import Problem
from hippodrome.deployment.core import explain
from hippodrome.deployment.core.finding import Finding, Mark
from hippodrome.deployment.operate.doctor.rehearsal import CheckFailed

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
    "data": "`hippodrome data` finds every answer and every recording",
    "timer": "a server that is not stopped is ended by its timer",
    "sweep": "the sweep removes what no server owns",
    "alarm": "an alarm reaches its topic, and its subscribers",
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
DEBUG = "Run it again with HIPPODROME_DEBUG=1 and send us what it prints."


class Transcript:
    """Collects the lines of a rehearsal, and removes secrets from every text first."""

    def __init__(self) -> None:
        self.findings: list[Finding] = []  # by `check`, the key of a line
        self._at: list[float] = []  # for each, the seconds from the beginning
        self._began, self._clock = datetime.now(UTC), time.monotonic()
        self._secrets: set[str] = set()

    def hide(self, *secrets: str | None) -> None:
        """Remove these names and codes from all later lines. No pattern would find them."""
        self._secrets.update(filter(None, secrets))

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

    def say(self, key: str, mark: Mark, text: str, advice: str = "") -> None:
        """Add a line. Raises KeyError if its key is not among `LINES`."""
        LINES[key]
        self.findings.append(Finding(key, mark, self.clean(text), self.clean(advice)))
        self._at.append(round(time.monotonic() - self._clock, 1))

    def part(self, key: str, part: Callable[[], str | None]) -> bool:
        """Run a part of the rehearsal, add the line that it returns, and return whether it succeeded.

        If it has not, the line says why, and what to do.
        """
        try:
            text = part()
        except CheckFailed as failed:
            self.say(key, failed.mark, str(failed), failed.advice)
        except Exception as error:  # noqa: BLE001 - the other parts go on
            problem = explain.problem_from(error) or Problem(f"{type(error).__name__}: {error}", DEBUG)
            self.say(key, Mark.BAD, " ".join([str(problem), *problem.details]), problem.advice)
        else:
            if text:
                self.say(key, Mark.GOOD, text)
            return True
        return False

    @property
    def proven(self) -> list[str]:
        """The keys of proven results: all their lines are good."""
        marks = {key: {line.mark for line in self.findings if line.check == key} for key in LINES}
        return [key for key in LINES if marks[key] == {Mark.GOOD}]

    def document(self, region: str, bots: int) -> dict[str, Any]:
        """Return the transcript as JSON data, for a file."""
        return {
            "schema": SCHEMA,
            "what": "a rehearsal with simulated participants on a real account",
            "began": self._began.isoformat(timespec="seconds"),
            "region": region,
            "bots": bots,
            "proven": {key: LINES[key] for key in self.proven},
            "lines": [
                {"key": line.check, "mark": line.mark, "text": line.text, "at": at}
                | ({"advice": line.advice} if line.advice else {})
                for line, at in zip(self.findings, self._at, strict=True)
            ],
        }
