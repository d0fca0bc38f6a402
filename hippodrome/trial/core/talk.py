"""Talk: what participants and the agent say to each other in one trial. Pure: it emits effects.

Two participants read each other if `trial.chat.with` names one of them. The agent speaks for the names in it that no
participant plays. A line is said once: a client may send it again, with the same id, until it reads the line.

A *circle* is the people whose turns follow each other: all of them if they read each other, else each person with the
agent alone.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from hippodrome.protocol.trial_sections import AI, ChatSection
from hippodrome.trial.core.effects import AskReply, Effect, Moderate, RecordTalk
from hippodrome.trial.core.messages import Say

MAX_SAID = 4_000
"""The most characters of a line that the agent says."""
MAX_NEWLINES = 10
RATE, RATE_SECONDS = 5, 5.0
"""The most lines of a participant within so many seconds."""
MAX_UNANSWERED = 5
"""The most lines of a participant that wait for `moderate` or `reply`: the others' lines wait behind them."""
AGENT_RATE = 20
"""The most lines of the agent within a second; further ones are dropped."""
_NEWLINE = re.compile("\r\n|[\r\u2028\u2029]")
_CONTROL = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
SHOWN_LINES = 500
"""The most lines that a client is sent when it connects: the last ones."""

Why = Literal["tooFast", "tooLong", "notYourTurn", "notAPhrase", "empty", "held"]
Send = Callable[[str, Mapping[str, Any]], None]
"""Sends a player's client, if there is one, the message with these fields."""


@dataclass(slots=True)
class Line:
    """A line that was said. `to`: who reads it beside its speaker; None for everybody."""

    n: int
    by: str
    text: str
    to: tuple[str, ...] | None = None
    id: int | None = None
    episode: int = 1
    step: int = 0
    more: bool = False
    """Whether the agent has not finished it."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Further fields for the record: `typed`, `original`, `asked`."""

    def read_by(self, name: str) -> bool:
        """Whether this name reads the line."""
        return self.to is None or name in self.to or name == self.by

    def record(self) -> dict[str, Any]:
        """Return the fields for the tape."""
        known = {"to": None if self.to is None else list(self.to), "id": self.id}
        optional = {key: value for key, value in known.items() if value is not None}
        where = {"episode": self.episode, "step": self.step}
        return {"kind": "line", "n": self.n, "by": self.by, "text": self.text, **optional, **where, **self.fields}

    def shown_to(self, player: str) -> dict[str, Any]:
        """Return the fields for a client of this player."""
        shown: dict[str, Any] = {"n": self.n, "by": self.by, "text": self.text}
        if self.by == player and self.id is not None:
            shown["id"] = self.id
        if self.more:
            shown["more"] = True
        return shown


@dataclass(slots=True)
class _Circle:
    """Those whose turns follow each other, and whose turn it is."""

    speakers: tuple[str, ...]
    at: int = 0
    checked: bool = False
    """Whether a line of the one whose turn it is waits for `moderate`."""

    @property
    def turn(self) -> str:
        return self.speakers[self.at]

    def pass_on(self, silent: Collection[str]) -> None:
        """Let the next one speak who is not `silent`."""
        for _ in self.speakers:
            self.at = (self.at + 1) % len(self.speakers)
            if self.turn not in silent:
                return


class Talk:
    """The talk of one trial. `people` are the players whom participants play, in the environment's order.

    `replies`: whether the agent answers lines. `moderates`: whether it looks at each line first. `where` returns the
    present episode and step.
    """

    def __init__(
        self,
        chat: ChatSection,
        people: Sequence[str],
        names: Mapping[str, str],
        *,
        where: Callable[[], tuple[int, int]],
        send: Send,
        emit: Callable[[Effect], None],
    ) -> None:
        """`names`: what participants read instead of the players' names."""
        self.lines: list[Line] = []
        self.replies = self.moderates = False
        self._chat = chat
        self.people = tuple(people)
        """The players whom participants play."""
        self._names = {**names, **chat.names}
        self._where = where
        self._send = send
        self._emit = emit
        default = people if len(people) > 1 else (AI,)
        self._named = chat.partners or tuple(default)
        self.agents = tuple(name for name in self._named if name not in people)
        """The names for which the agent speaks."""
        self._n = 0
        self._said: dict[tuple[str, int], Line | None] = {}  # by player and id; None while `moderate` has it, or held
        self._times: dict[str, deque[float]] = {}
        self._typing: set[str] = set()
        self._silent: Collection[str] = ()
        self._asked: dict[int, tuple[str, Line | None, tuple[str, ...] | None]] = {}  # questions that wait for `reply`
        self._checked: dict[int, tuple[str, Say]] = {}  # lines that wait for `moderate`
        self._growing: dict[int, Line] = {}
        self._ask_id = 0  # of the last question to the agent
        self._begun: set[int] = set()
        self._circles = self._make_circles()
        self._answered: set[int] = set()  # lines that earlier servers' agents have answered
        self._unanswered: list[Line] = []  # lines that they have not

    def restore(self, records: Iterable[Mapping[str, Any]]) -> None:
        """Take over what earlier servers have recorded, before anything is said."""
        answered: set[int] = set()
        for record in records:
            kind = record["kind"]
            if kind == "answered":
                answered.add(record["n"])
            elif kind == "line" and record.get("held"):
                self._said[record["by"], record["id"]] = None
            elif kind == "line":
                self._restore_line(record)
        answered |= {line.fields["answers"] for line in self.lines if "answers" in line.fields}
        self._unanswered = [line for line in self.lines if self._is_for_agent(line) and line.n not in answered]
        self._answered = answered

    def _restore_line(self, record: Mapping[str, Any]) -> None:
        n, by, text, to = record["n"], record["by"], record["text"], record.get("to")
        fields = {"answers": record["answers"]} if "answers" in record else {}
        where = record["episode"], record["step"]
        line = Line(n, by, text, None if to is None else tuple(to), record.get("id"), *where, fields=fields)
        self.lines.append(line)
        self._n = max(self._n, line.n)
        if line.id is not None:
            self._said[line.by, line.id] = line
        for circle in self._all_circles():
            if line.by in circle.speakers and any(line.read_by(name) for name in circle.speakers if name != line.by):
                circle.at = circle.speakers.index(line.by)
                circle.pass_on(())

    def _is_for_agent(self, line: Line) -> bool:
        agent = self.agents[:1]
        return line.by in self.people and bool(agent) and (line.to is None or agent[0] in line.to)

    def repeats(self, episode: int) -> list[tuple[int, AskReply]]:
        """Return what earlier servers have asked the agent in this episode and it has answered, after the step."""
        asked = [
            (line.step, AskReply(0, line.by, line.text, line.n))
            for line in self.lines
            if line.episode == episode and self._is_for_agent(line) and line.n in self._answered
        ]
        greetings = [
            (line.step, AskReply(0, line.to[0] if line.to else self.people[0], "", None))
            for line in self.lines
            if line.episode == episode and line.fields.get("answers") == 0
        ]
        return sorted([*greetings, *asked], key=lambda repeat: repeat[0])

    # ---- who talks to whom

    def partners_of(self, player: str) -> tuple[str, ...]:
        """Return the names to whom this player talks."""
        others = self.people if player in self._named else self._named
        mine = [name for name in (*others, *self.agents) if name != player]
        return tuple(dict.fromkeys(mine))

    def _readers(self, player: str) -> tuple[str, ...] | None:
        """Return who reads this player's lines; None for everybody."""
        partners = self.partners_of(player)
        everybody = {*self.people, *self.agents} - {player}
        return None if everybody <= set(partners) else partners

    def _make_circles(self) -> dict[str, _Circle]:
        agent = self.agents[:1]
        if any(set(self.partners_of(player)) & set(self.people) for player in self.people):
            together = self._circle((*self.people, *agent))
            return dict.fromkeys(self.people, together)
        return {player: self._circle((player, *agent)) for player in self.people}

    def _circle(self, speakers: tuple[str, ...]) -> _Circle:
        first = self._chat.first
        return _Circle(speakers, speakers.index(first) if first in speakers else 0)

    def _all_circles(self) -> list[_Circle]:
        return list({id(circle): circle for circle in self._circles.values()}.values())

    @property
    def alternates(self) -> bool:
        """Whether one speaks after the other."""
        return self._chat.turns == "alternate"

    def silence(self, players: Collection[str]) -> None:
        """Let these players' turns pass from now on: their participants are away for good."""
        self._silent = players
        for circle in self._all_circles():
            if circle.turn in players:
                self._next_turn(circle, None)
                self._tell_turn(circle)

    # ---- clients

    def fields(self, player: str) -> dict[str, Any]:
        """Return the field `chat` of the controls for a client of this player."""
        chat, partners = self._chat, self.partners_of(player)
        return {
            "me": player,
            "names": self._names,
            "with": list(partners),
            "maxLength": chat.max_length,
            "turns": chat.turns,
            "typing": chat.typing,
            "phrases": list(chat.phrases),
        }

    def connected(self, player: str) -> None:
        """Send a client that has connected the lines so far. The first client lets the agent speak first."""
        self._begin(player)
        lines = [line for line in self.lines if line.read_by(player)][-SHOWN_LINES:]
        self._tell(player, lines)
        typing = [name for name in self._typing if name in self.partners_of(player)]
        if typing:
            self._send(player, {"typing": dict.fromkeys(typing, True)})

    def _begin(self, player: str) -> None:
        circle = self._circles[player]
        if id(circle) in self._begun:
            return
        self._begun.add(id(circle))
        for line in self._unanswered:
            if line.by in circle.speakers and (not self.alternates or circle.turn in self.agents):
                self._ask(line.by, line.text, line, self._answer_readers(line))
        if self.alternates and circle.turn in self.agents and not self.replies:
            self._next_turn(circle, None)
        agent_is_first = bool(self.agents) and self._chat.first == self.agents[0]
        if agent_is_first and not any(line.read_by(player) for line in self.lines):
            everybody = len(circle.speakers) > 2 or len(self.people) == 1
            self._ask(player, "", None, None if everybody else (player,))

    def disconnected(self, player: str) -> None:
        """Tell the others that this player does not type any more."""
        self._types(player, False)

    def typing(self, player: str, types: bool) -> None:
        """Tell the others whether a player types."""
        self._types(player, types)

    def _types(self, name: str, types: bool, readers: Sequence[str] | None = None) -> None:
        if types == (name in self._typing):
            return
        (self._typing.add if types else self._typing.discard)(name)
        to = readers if readers is not None else self.people if name in self.agents else self.partners_of(name)
        for player in self.people:
            if player != name and player in to:
                self._send(player, {"typing": {name: types}})

    def _tell(self, player: str, lines: Sequence[Line]) -> None:
        fields: dict[str, Any] = {"lines": [line.shown_to(player) for line in lines]}
        if self.alternates:
            fields["turn"] = self._circles[player].turn
        self._send(player, fields)

    def _tell_readers(self, line: Line) -> None:
        for player in self.people:
            if line.read_by(player):
                self._tell(player, (line,))

    # ---- participants

    def say(self, player: str, say: Say, now: float) -> None:
        """Say a participant's line, or refuse it. A line that was heard before is sent again."""
        known = (player, say.id)
        if known in self._said:
            line = self._said[known]
            if line is not None:
                self._tell(player, (line,))
            elif not any((by, waiting.id) == known for by, waiting in self._checked.values()):
                self._refuse(player, say, "held")
            return
        text = tidied(say.text)
        why = self._why_not(player, text, now)
        if why is not None:
            self._refuse(player, say, why)
            return
        self._times.setdefault(player, deque(maxlen=RATE)).append(now)
        say = Say(say.id, text, say.typed)
        if self.moderates:
            self._said[known] = None
            self._ask_id += 1
            self._checked[self._ask_id] = (player, say)
            self._circles[player].checked = True
            self._emit(Moderate(self._ask_id, player, text))
        else:
            self._said_by(player, say, text, {})

    def _why_not(self, player: str, text: str, now: float) -> Why | None:
        chat, times = self._chat, self._times.get(player) or deque()
        if not text:
            return "empty"
        if len(text) > chat.max_length:
            return "tooLong"
        if not chat.typing and text not in chat.phrases:
            return "notAPhrase"
        circle = self._circles[player]
        if self.alternates and (circle.turn != player or circle.checked):
            return "notYourTurn"
        if len(times) == RATE and now - times[0] < RATE_SECONDS:
            return "tooFast"
        if self._waiting(player) >= MAX_UNANSWERED:
            return "tooFast"
        return None

    def _waiting(self, player: str) -> int:
        """Return how many of this player's lines wait for `moderate` or `reply`."""
        asked = sum(by == player and line is not None for by, line, _ in self._asked.values())
        return asked + sum(by == player for by, _ in self._checked.values())

    def _refuse(self, player: str, say: Say, why: Why) -> None:
        self._send(player, {"refused": {"id": say.id, "why": why}})

    def moderated(self, ask_id: int, result: str | bool | None) -> None:
        """Say a line that `moderate` has seen: None as it is, a text instead of it, False not at all."""
        waiting = self._checked.pop(ask_id, None)
        if waiting is None:
            return
        player, say = waiting
        self._circles[player].checked = False
        if result is False:
            episode, step = self._where()
            held = {"by": player, "text": say.text, "id": say.id, "held": True, "episode": episode, "step": step}
            self._emit(RecordTalk({"kind": "line", **held}))
            self._refuse(player, say, "held")
            return
        text = tidied(result, MAX_SAID) if isinstance(result, str) else say.text
        self._said_by(player, say, text, {} if text == say.text else {"original": say.text})

    def _said_by(self, player: str, say: Say, text: str, fields: Mapping[str, Any]) -> None:
        typed = {} if say.typed is None else {"typed": say.typed}
        line = self._record(self._append(player, text, self._readers(player), id=say.id, fields={**fields, **typed}))
        self._said[player, say.id] = line
        self._types(player, False)
        circle = self._circles[player]
        if not self.alternates:
            self._tell_readers(line)
            if self.agents and self.replies and (line.to is None or self.agents[0] in line.to):
                self._ask(player, text, line, self._answer_readers(line))
        else:
            self._next_turn(circle, line)
            self._tell_turn(circle, line)
            self._tell_readers(line)

    def _answer_readers(self, line: Line) -> tuple[str, ...] | None:
        """Return who reads an answer to this line: who has read the line."""
        if line.to is None:
            return None
        return (line.by, *(name for name in line.to if name in self.people))

    def _next_turn(self, circle: _Circle, line: Line | None) -> None:
        """Let the next one speak; if that is the agent, ask it."""
        agents_too = {*self._silent, *self.agents}
        circle.pass_on(self._silent if self.replies else agents_too)
        if circle.turn in self.agents:
            line = line or next((each for each in reversed(self.lines) if each.by in circle.speakers), None)
            if line is None or line.by in self.agents:
                circle.pass_on(agents_too)
            else:
                self._ask(line.by, line.text, line, self._answer_readers(line))

    def _tell_turn(self, circle: _Circle, line: Line | None = None) -> None:
        """Tell whose turn it is now, except those who read it with this line."""
        for player in self.people:
            if self._circles[player] is circle and (line is None or not line.read_by(player)):
                self._tell(player, ())

    # ---- the agent

    def _ask(self, player: str, text: str, line: Line | None, to: tuple[str, ...] | None) -> None:
        if not self.replies:
            return
        self._ask_id += 1
        self._asked[self._ask_id] = (player, line, to)
        self._types(self.agents[0], True, self.people if to is None else to)
        self._emit(AskReply(self._ask_id, player, text, None if line is None else line.n))

    def reply_grows(self, ask_id: int, text: str) -> None:
        """Show what the agent's `reply` has yielded so far; `text` is all of it."""
        if ask_id not in self._asked:
            return
        text = tidied(text, MAX_SAID)
        line = self._growing.get(ask_id)
        if line is None and text:
            line = self._growing[ask_id] = self._answer_of(ask_id, text)
            line.more = True
        if line is not None:
            line.text = text
            self._tell_readers(line)

    def reply_ended(self, ask_id: int, text: str | None) -> None:
        """Say what the agent's `reply` has returned, or all that it has yielded. None or "": it says nothing."""
        asked = self._asked.get(ask_id)
        if asked is None:
            return
        text = tidied(text or "", MAX_SAID)
        line = self._growing.pop(ask_id, None)
        if line is None and text:
            line = self._answer_of(ask_id, text)
        del self._asked[ask_id]
        if line is not None:
            line.text, line.more = text or line.text, False
            self._record(line)
        elif asked[1] is not None:
            self._emit(RecordTalk({"kind": "answered", "n": asked[1].n}))
        if not self._asked:
            self._types(self.agents[0], False)
        circle = self._circles[asked[0]]
        if self.alternates and circle.turn in self.agents:
            circle.pass_on(self._silent)
            self._tell_turn(circle, line)
        if line is not None:
            self._tell_readers(line)

    def _answer_of(self, ask_id: int, text: str) -> Line:
        _, line, to = self._asked[ask_id]
        return self._append(self.agents[0], text, to, fields={"answers": 0 if line is None else line.n})

    def agent_says(self, text: str, to: Sequence[str] | None, by: str | None, now: float) -> bool:
        """Say a line of the agent. Return False if it was dropped, because there are too many."""
        by = by or self.speaker
        text = tidied(text, MAX_SAID)
        times = self._times.setdefault("", deque(maxlen=AGENT_RATE))
        if not text or (len(times) == AGENT_RATE and now - times[0] < 1.0):
            return not text
        times.append(now)
        line = self._record(self._append(by, text, None if to is None else tuple(to)))
        for circle in self._all_circles() if self.alternates else ():
            if circle.turn == by:
                self._next_turn(circle, None)
        self._tell_readers(line)
        return True

    @property
    def speaker(self) -> str:
        """The name under which the agent speaks if it does not say which."""
        return self.agents[0] if self.agents else AI

    # ---- lines

    def _record(self, line: Line) -> Line:
        self._emit(RecordTalk(line.record()))
        return line

    def _append(
        self,
        by: str,
        text: str,
        to: tuple[str, ...] | None,
        *,
        id: int | None = None,
        fields: Mapping[str, Any] | None = None,
    ) -> Line:
        self._n += 1
        episode, step = self._where()
        line = Line(self._n, by, text, to, id, episode, step, fields=fields or {})
        self.lines.append(line)
        return line

    def lines_of(self, player: str | None, n: int | None) -> list[Line]:
        """Return the lines that a player may read, all with None. For any thread.

        If the agent is to answer line `n`: without what people said after it, and without what the agent said after its
        answer, which there is if steps are taken again; and with line `n` as the last one.
        """
        lines = [line for line in list(self.lines) if player is None or line.read_by(player)]
        if n is None:
            return lines
        end = next((line.n for line in lines if line.fields.get("answers") == n), self._n + 1)
        before = [line for line in lines if (line.n < n if line.by in self.people else line.n < end)]
        return before + [line for line in lines if line.n == n]

    def said_by(self, player: str) -> int:
        """Return the number of lines that the player has said."""
        return sum(line.by == player for line in self.lines)

    def close(self) -> None:
        """Record the lines that the agent has not finished, because the server must end. The next server asks again."""
        for line in self._growing.values():
            self._emit(RecordTalk({**line.record(), "kind": "cut"}))
        self._growing.clear()
        self._asked.clear()


def tidied(text: str, most: int | None = None) -> str:
    """Return what is said of a text: without control characters, at most MAX_NEWLINES newlines, no blanks around it.

    With `most`, the first so many characters of it.
    """
    if most is not None:
        text = text[:most]
    text = _CONTROL.sub("", _NEWLINE.sub("\n", text).replace("\t", " ")).strip()
    head = text.split("\n", MAX_NEWLINES)
    head[-1] = head[-1].replace("\n", " ")
    return "\n".join(head)
