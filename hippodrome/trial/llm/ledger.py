"""Which calls of a game were made, what they have cost, and which answers the tape holds. Pure, but for a lock."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from hippodrome.protocol.trial_llm import LlmSection

CHARACTERS_A_TOKEN = 4  # of texts in English; used only if the model does not say what a call has cost


class Refused(Exception):
    """The endpoint does not pass a request on. `code` is for programs, the message for people."""

    def __init__(self, status: int, code: str, words: str) -> None:
        super().__init__(words)
        self.status = status
        self.code = code


@dataclass(frozen=True, slots=True)
class Moment:
    """When in the game something is asked. Before the first episode, `episode` is 0."""

    episode: int = 0
    step: int = 0
    """Steps taken in the episode."""
    replaying: bool = False
    """Whether steps of an earlier server are being taken again."""
    line: int | None = None
    """The number of the line that is being answered."""


@dataclass(frozen=True, slots=True)
class Tokens:
    """What a call has cost."""

    input: int = 0
    output: int = 0
    estimated: bool = False

    @property
    def total(self) -> int:
        return self.input + self.output

    def document(self) -> dict[str, Any]:
        """Return the tokens for the tape."""
        return {"input": self.input, "output": self.output, **({"estimated": True} if self.estimated else {})}


@dataclass(slots=True)
class Call:
    """A call that has begun. `recorded` is its record on the tape of an earlier server, or None if it is to be made."""

    hash: str
    nth: int
    moment: Moment
    recorded: Mapping[str, Any] | None = None


@dataclass(slots=True)
class Ledger:
    """The calls of one game. All methods may be called on any thread."""

    section: LlmSection
    calls: int = 0
    """Calls that were made, by this server and by earlier ones."""
    input: int = 0
    output: int = 0
    _tape: dict[str, list[Mapping[str, Any]]] = field(default_factory=dict)  # by hash
    _last_step: dict[int, int] = field(default_factory=dict)  # by episode, of the calls on the tape
    _seen: dict[tuple[int, str], int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @classmethod
    def of(cls, section: LlmSection, earlier: Iterable[Mapping[str, Any]]) -> Ledger:
        """Return the ledger of a game of which earlier servers have these records, also of other kinds."""
        ledger = cls(section)
        for record in earlier:
            if record.get("kind") != "call":
                continue
            episode, tokens = int(record.get("episode") or 0), record.get("tokens") or {}
            ledger._tape.setdefault(str(record.get("hash")), []).append(record)
            step = int(record.get("step") or 0)
            ledger._last_step[episode] = max(step, ledger._last_step.get(episode, 0))
            ledger.calls += 1
            ledger.input += int(tokens.get("input") or 0)
            ledger.output += int(tokens.get("output") or 0)
        return ledger

    def summary(self) -> dict[str, Any]:
        """Return how many calls were made, and their tokens, for the answer."""
        return {"calls": self.calls, "tokens": {"input": self.input, "output": self.output}}

    @property
    def tokens(self) -> int:
        return self.input + self.output

    def begin(self, path: str, request: Mapping[str, Any], moment: Moment) -> Call:
        """Begin a call: find its answer on the tape, or count it. Raises Refused."""
        digest = request_hash(path, request)
        place = moment.episode, digest
        with self._lock:
            nth = self._seen[place] = self._seen.get(place, 0) + 1
            recorded = self._take(digest, moment.episode)
            if recorded is not None:
                return Call(digest, nth, moment, recorded)
            # What a lost server had not stored yet comes after all that it had stored. Any other call was never made.
            if moment.replaying and moment.step < self._last_step.get(moment.episode, 0):
                words = (
                    "the earlier server has not asked this at this step; it is not asked while its steps are repeated"
                )
                raise Refused(409, "not_on_tape", words)
            if self.calls >= self.section.max_calls:
                raise Refused(429, "cap_reached", f"this game has made {self.calls} calls; llm.maxCalls allows no more")
            if self.tokens >= self.section.max_tokens:
                raise Refused(
                    429, "cap_reached", f"this game has used {self.tokens} tokens; llm.maxTokens allows no more"
                )
            self.calls += 1
        return Call(digest, nth, moment)

    def _take(self, digest: str, episode: int) -> Mapping[str, Any] | None:
        """Take the first answer to this request off the tape, of this episode or of before the game; None without one.

        Before the game, a line of the last episode may be answered again.
        """
        episodes = (0, max(self._last_step, default=0)) if episode == 0 else (0, episode)
        records = self._tape.get(digest, [])
        for index, record in enumerate(records):
            if int(record.get("episode") or 0) in episodes:
                return records.pop(index)
        return None

    def end(self, tokens: Tokens) -> None:
        """Count what a call has cost that was made."""
        with self._lock:
            self.input += tokens.input
            self.output += tokens.output


def request_hash(path: str, request: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a request, by which the tape knows it: of its path and its body with sorted keys."""
    body = json.dumps(request, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(f"{path}\n{body}".encode()).hexdigest()


def text_hash(text: str) -> str:
    """Return 16 digits of the SHA-256 of a prompt: enough to tell the prompts of a study apart."""
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def tokens_of(answer: Any) -> Tokens | None:
    """Return the tokens that an answer, or an event of a stream, reports; None if it reports none."""
    if not isinstance(answer, Mapping):
        return None
    inner = answer.get("response")  # an event `response.completed`
    usage = answer.get("usage") or (inner.get("usage") if isinstance(inner, Mapping) else None)
    if not isinstance(usage, Mapping):
        return None
    counts = [
        next((value for name in names if type(value := usage.get(name)) is int and value >= 0), None)
        for names in (("prompt_tokens", "input_tokens"), ("completion_tokens", "output_tokens"))
    ]
    return None if counts == [None, None] else Tokens(counts[0] or 0, counts[1] or 0)


def estimate(request: Mapping[str, Any], answered: int) -> Tokens:
    """Estimate what a call has cost from its request and the number of characters of the answer."""
    asked = sum(map(len, _texts({key: request.get(key) for key in ("messages", "input", "instructions", "tools")})))
    return Tokens(-(-asked // CHARACTERS_A_TOKEN), -(-answered // CHARACTERS_A_TOKEN), estimated=True)


def _texts(value: Any) -> Iterable[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _texts(inner)
