"""docs/first-hour.md as the tests read it: its commands, what it shows of their output, and the words of its failures.

A command and its output stand in a block `console`, after `$ `. A line `…` stands for any lines, a `…` in a line for
anything. Numbers, ids, regions and the domain may differ; all else is to be printed as it stands.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "first-hour.md"
DOMAIN = "play.example.org"
GAP = "…"


@cache
def text() -> str:
    return PAGE.read_text()


@cache
def shown() -> dict[str, tuple[str, ...]]:
    """Each command of a block with the lines that the page shows of its output. AssertionError if one is there twice."""
    found: dict[str, tuple[str, ...]] = {}
    for block in re.findall(r"```console\n(.*?)```", text(), re.DOTALL):
        for part in re.split(r"(?m)^\$ ", block)[1:]:
            command, *lines = part.splitlines()
            assert command not in found, command
            found[command] = tuple(line for line in lines if line.strip())
    return found


def inline() -> set[str]:
    """Return the commands that stand in sentences."""
    sentences = re.sub(r"```.*?```", "", text(), flags=re.DOTALL)
    return set(re.findall(r"`((?:make|python) [^`]+)`", sentences))


def failures() -> list[str]:
    """Return the first column of the table of failures: what the program says."""
    table = text().partition("| it says |")[2].partition("\n\n")[0]
    return re.findall(r"(?m)^\| (.+?) \|", table.partition("\n|---")[2])


def masked(line: str) -> str:
    """Return the line without what differs from account to account."""
    line = re.sub(r"\b[a-z]{2}-[a-z]+-\d\b", "REGION", line)
    line = re.sub(r"\b(?=[A-Za-z]*\d)[0-9A-Za-z]{8,}\b", "#", line)
    line = re.sub(r"(?<![\w.])-?\d[\d.,]*\b", "#", line)
    line = re.sub(r"# (?:bytes?|KB|MB|GB)\b", "# bytes", line)
    return " ".join(line.split()).replace("# min", "# s")


def differs(expected: Sequence[str], printed: str, domain: str = DOMAIN) -> str:
    """Return the first line of the page that was not printed there; "" if the output is as shown."""
    lines = [masked(line.replace(domain, DOMAIN)) for line in printed.splitlines() if line.strip()]
    anywhere, at = False, 0
    for line in expected:
        if line.strip() == GAP:
            anywhere = True
            continue
        pattern = re.compile(".*".join(map(re.escape, masked(line).split(GAP))))
        places = range(at, len(lines) if anywhere else at + 1)
        place = next((n for n in places if n < len(lines) and pattern.fullmatch(lines[n])), None)
        if place is None:
            return line
        anywhere, at = False, place + 1
    return "" if anywhere or at == len(lines) else f"(the end; but there comes: {lines[at]})"
