"""Reads the messages of clients, and builds the messages of the server (docs/wire.md). Pure."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.protocol.trial import TrialSection

PLAIN_COMMANDS = frozenset({"start", "pause", "reset", "stop", "requestUI"})
FEEDBACK = frozenset({"good", "bad", "trainOnline", "trainOffline"})
FRAME_RATE_CONTROLS = {"faster": "fpsUp", "slower": "fpsDown"}
"""The control of `ui` that allows each of these changes. The control `fpsSet` allows a change to a number."""
_BUTTONS_OF_ACTIONS = frozenset({"fire", "leftup", "rightup", "leftdown", "rightdown"})
"""Further controls that are actions in HIPPO's front end, also if the action space has none of that name."""

DECODABLE = frozenset({"deflate", "jpeg", "objects"})
"""What a client may name in `decodes` of its first message (docs/wire.md)."""
_DECODED_BY_DEFAULT = frozenset({"deflate"})

_FIELDS = frozenset(
    {"command", "action", "key", "held", "changeFrameRate", "ack", "asset", "hidden", "form", "say", "typing"}
)
FORM_PAGES = ("instructions", "betweenEpisodes")
"""The keys of `trial` that name the pages whose fields a client sends."""
MAX_FORM, MAX_FORM_FIELDS = 100_000, 200
"""The most characters of a form's values, and the most fields."""


class NotAMessage(ValueError):
    """The message is not a JSON object. The third one on a connection closes it (4400)."""


class BadMessage(ValueError):
    """The JSON object has an unknown field or a wrong value. The client is sent the text of this error."""


class CommandRefused(ValueError):
    """A client asked for something that is not possible now. The client is sent the text of this error."""


class CloseConnection(Exception):
    """The connection is to be closed with this code, after the client has been sent these words."""

    def __init__(self, code: int, words: str) -> None:
        super().__init__(words)
        self.code = code
        self.words = words


@dataclass(frozen=True, slots=True)
class Hello:
    """A client's first message. Fields it left out are None."""

    user_id: str | None
    token: str | None
    step: str | None
    names_project: bool = False
    """The message has a field `projectId`, as HIPPO's front end sends it."""
    project_id: str | None = None
    """The value of that field, if it is a text."""
    decodes: frozenset[str] = _DECODED_BY_DEFAULT
    """What the client decodes, of DECODABLE. Clients without our subprotocol do not say it, and get JPEGs in JSON."""


@dataclass(frozen=True, slots=True)
class Form:
    """What a participant has filled in on a page in the game: by field a text, or a list of texts.

    `page` is the key of `trial` that names the page.
    """

    page: str
    fields: Mapping[str, str | list[str]]


@dataclass(frozen=True, slots=True)
class Say:
    """A line that a participant says. `id` counts the lines of the participant from 1.

    `typed`: milliseconds from the first key until the line was sent; None if the client does not say it.
    """

    id: int
    text: str
    typed: int | None = None


@dataclass(frozen=True, slots=True)
class Message:
    """One later message. Fields it left out are None."""

    command: str | None = None
    action: str | None = None
    held: bool | None = None
    frame_rate: str | float | None = None
    ack: int | None = None
    asset: str | None = None
    """The name of the image that the client asks for."""
    lasts: bool = False
    """The action acts until the client's next action, as HIPPO's clients expect."""
    fields: Mapping[str, Any] | None = None
    """Unknown fields of a client without a subprotocol. They are recorded, and have no other effect."""
    fields_dropped: int = 0
    """The number of unknown fields that are not recorded because they are too long."""
    key: str | None = None
    """The name of a key of the keyboard, in a project with `keys`."""
    hidden: bool | None = None
    """Whether the participant looks at another tab or application. Only clients of a session send it."""
    form: Form | None = None
    say: Say | None = None
    typing: bool | None = None
    """Whether the participant types a line."""

    def record(self) -> dict[str, Any]:
        """Return the fields for the recording: all but `ack`, `asset`, `hidden`, the command `requestUI`, and talk."""
        fields: dict[str, Any] = {}
        if self.command is not None and self.command != "requestUI":
            fields["command"] = self.command
        if self.action is not None:
            fields["action"] = self.action
        if self.key is not None:
            fields["key"] = self.key
        if self.held is not None:
            fields["held"] = self.held
        if self.frame_rate is not None:
            fields["changeFrameRate"] = self.frame_rate
        if self.form is not None:
            fields["form"] = {"page": self.form.page, "fields": self.form.fields}
        if self.fields:
            fields["fields"] = self.fields
        if self.fields_dropped:
            fields["fieldsDropped"] = self.fields_dropped
        return fields


def object_of(data: str | bytes) -> dict[str, Any]:
    """Parse a message, which is a JSON object. Raises NotAMessage."""
    if not isinstance(data, str):
        raise NotAMessage("messages are JSON text, not bytes")
    try:
        value = json.loads(data)
        if "\\u" in data:  # half of a surrogate pair, which UTF-8 cannot hold, comes only as an escape
            json.dumps(value, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise NotAMessage("that is not JSON in UTF-8") from error
    if not isinstance(value, dict):
        raise NotAMessage("a message is a JSON object")
    return value


def parse_hello(data: str | bytes) -> Hello:
    """Read a client's first message. Unknown fields are ignored. Raises NotAMessage or BadMessage."""
    value = object_of(data)
    for key in ("userId", "token"):
        if not isinstance(value.get(key), str | None):
            raise BadMessage(f"{key} must be a text")
    step = value.get("step")
    if isinstance(step, bool) or not isinstance(step, str | int | None):
        raise BadMessage("step must be a text")
    step = None if step is None else str(step)[:64]
    project = value.get("projectId")
    return Hello(
        value.get("userId"),
        value.get("token"),
        step,
        names_project="projectId" in value,
        project_id=project if isinstance(project, str) else None,
        decodes=_decodes(value.get("decodes")),
    )


def _decodes(names: Any) -> frozenset[str]:
    """Return the names of DECODABLE among these; `deflate` if the client has left them out."""
    if names is None:
        return _DECODED_BY_DEFAULT
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadMessage("decodes must be a list of texts")
    if not {"deflate", "jpeg"} & set(names):
        raise BadMessage("decodes must name deflate or jpeg")
    return DECODABLE & set(names)


def words_of(trial: TrialSection) -> tuple[str, ...]:
    """Return the project's own words of feedback: the names of its own controls, except those that name an action."""
    actions = {*trial.action_space, *_BUTTONS_OF_ACTIONS}
    return tuple(name for name in trial.ui.own if name.lower() not in actions)


def is_feedback(command: str | None) -> bool:
    """Whether the command of a message is a word of feedback: one of FEEDBACK or of the project's own words."""
    return command is not None and command not in PLAIN_COMMANDS


def parse(data: str | bytes, words: Collection[str] = ()) -> Message:
    """Read a message after the hello. `words` are the project's (`words_of`). Raises NotAMessage or BadMessage."""
    return message_of(object_of(data), words)


def message_of(value: Mapping[str, Any], words: Collection[str] = ()) -> Message:
    """Check the fields of a message, and return it. `words` as in `parse`. Raises BadMessage."""
    unknown = value.keys() - _FIELDS
    if unknown:
        raise BadMessage(f"unknown field {_short(min(unknown))}")
    if not value:
        raise BadMessage("an empty message")
    command = value.get("command")
    known = isinstance(command, str) and (command in PLAIN_COMMANDS or command in FEEDBACK or command in words)
    if "command" in value and not known:
        raise BadMessage(f"unknown command {_short(command)}")
    action = value.get("action")
    # In the controls, a zero byte begins the names of keys, which have rules of their own.
    if "action" in value and (not isinstance(action, str) or not 0 < len(action) <= 64 or "\0" in action):
        raise BadMessage("action must be the name of an action")
    held = value.get("held")
    key = value.get("key")
    if "key" in value and (not isinstance(key, str) or not 0 < len(key) <= 32 or action is not None):
        raise BadMessage("key must be the name of a key, and come without an action")
    if "held" in value and (not isinstance(held, bool) or (action is None and key is None)):
        raise BadMessage("held must be true or false and come with an action or a key")
    return Message(
        command=command,
        action=action.strip().lower() if action is not None else None,
        held=held,
        frame_rate=_frame_rate(value["changeFrameRate"]) if "changeFrameRate" in value else None,
        ack=_ack(value["ack"]) if "ack" in value else None,
        key=key,
        asset=_asset(value["asset"]) if "asset" in value else None,
        hidden=_bool("hidden", value["hidden"]) if "hidden" in value else None,
        form=_form(value["form"]) if "form" in value else None,
        say=_say(value["say"]) if "say" in value else None,
        typing=_bool("typing", value["typing"]) if "typing" in value else None,
    )


def _frame_rate(value: Any) -> str | float:
    if value in ("faster", "slower"):
        return str(value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        # An int may be too large for a float. No project's limit comes near these bounds.
        value = max(-1e6, min(1e6, value)) if isinstance(value, int) else value
        if math.isfinite(value):
            return float(value)
    raise BadMessage("changeFrameRate must be 'faster', 'slower' or a number")


def _ack(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 0xFFFFFFFF:
        raise BadMessage("ack must be the id of a frame")
    return value


def _asset(value: Any) -> str:
    if not isinstance(value, str) or not 0 < len(value) <= 200:
        raise BadMessage("asset must be the name of an image")
    return value


def _form(value: Any) -> Form:
    fields = value.get("fields") if isinstance(value, dict) and value.get("page") in FORM_PAGES else None
    if not isinstance(fields, dict) or not all(map(_is_answer, fields.values())):
        raise BadMessage("form must have a page of the game, and fields with texts")
    if len(fields) > MAX_FORM_FIELDS or len(json.dumps(fields)) > MAX_FORM:
        raise BadMessage("the form is too long")
    return Form(value["page"], fields)


def _is_answer(value: Any) -> bool:
    return isinstance(value, str) or (isinstance(value, list) and all(isinstance(part, str) for part in value))


def _say(value: Any) -> Say:
    if not isinstance(value, dict) or not {"id", "text"} <= value.keys() <= {"id", "text", "typed"}:
        raise BadMessage("say must have id and text, and may have typed")
    number, text, typed = value["id"], value["text"], value.get("typed")
    if not _is_whole(number) or number < 1 or not isinstance(text, str):
        raise BadMessage("the id of a line must be a whole number from 1, and its text a text")
    if typed is not None and not _is_whole(typed):
        raise BadMessage("typed must be a whole number of milliseconds")
    return Say(number, text, typed)


def _is_whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**53


def _bool(name: str, value: Any) -> bool:
    if not isinstance(value, bool):
        raise BadMessage(f"{name} must be true or false")
    return value


def _short(value: Any) -> str:
    text = value if isinstance(value, str) else type(value).__name__
    return repr(text[:40])


def controls(
    *,
    ui: tuple[str, ...],
    frame_rate: int,
    min_frame_rate: int,
    max_frame_rate: int,
    frame_rate_step_size: int,
    allow_frame_rate_change: bool,
    action_space: tuple[str, ...],
    state: str,
    episode: int,
    max_episodes: int,
    score: float,
    episode_score: float,
    next_in: float | None = None,
    words: Collection[str] = (),
    player: str | None = None,
    players: Collection[str] = (),
    to_act: bool | None = None,
    turn_ends_in: float | None = None,
    chosen: str | None = None,
    time_up: str | None = None,
    scene: Mapping[str, Any] | None = None,
    starts_in: float | None = None,
    time_left: float | None = None,
    input_of_project: Mapping[str, Any] | None = None,
    session: Mapping[str, Any] | None = None,
) -> str:
    """Build the answer to a hello and to `requestUI`. docs/wire.md explains its fields.

    It has `words` only if the project has words of its own, the players only if there are several, and `toAct` only
    turn by turn. `scene` are the fields of a game that is drawn by objects. `input_of_project` are the project's keys,
    labels and kind of input. The other arguments are as in `state`, or keys of the project.
    """
    return json.dumps(
        {
            "UI": list(ui),
            "frameRate": frame_rate,
            "minFrameRate": min_frame_rate,
            "maxFrameRate": max_frame_rate,
            "frameRateStepSize": frame_rate_step_size,
            "allowFrameRateChange": allow_frame_rate_change,
            "actionSpace": list(action_space),
            "state": state,
            "episode": episode,
            "maxEpisodes": max_episodes,
            **_scores(score, episode_score, next_in),
            **({"words": list(words)} if words else {}),
            **({"player": player, "players": list(players)} if len(players) > 1 else {}),
            **({"pace": "turns"} if to_act is not None else {}),
            **_turn(to_act, turn_ends_in, chosen, time_up),
            **(scene or {}),
            **(input_of_project or {}),
            **seconds(startsIn=starts_in, timeLeft=time_left),
            **(session or {}),
        }
    )


def state(
    state: str,
    episode: int,
    score: float,
    frame_rate: int,
    *,
    episode_score: float,
    next_in: float | None = None,
    to_act: bool | None = None,
    turn_ends_in: float | None = None,
    chosen: str | None = None,
    time_up: str | None = None,
    starts_in: float | None = None,
    time_left: float | None = None,
    session: Mapping[str, Any] | None = None,
) -> str:
    """Build the message with the state of the trial. Times are seconds; a time of None is left out.

    `starts_in`: the time for which the episode's first picture is still shown before the game goes on. `time_left`: the
    time of play that is left in the episode. `next_in`: the time until the break ends. `to_act`: turn by turn, whether
    it is the client's turn; `turn_ends_in`: the time until that turn ends; `chosen`, `time_up`: the action that is
    chosen for the client's player, and what was chosen because the time was up (`TrialProgress.choice_of`). `session`:
    in a session, the fields about its members.
    """
    scores = _scores(score, episode_score, next_in)
    turn, times = _turn(to_act, turn_ends_in, chosen, time_up), seconds(startsIn=starts_in, timeLeft=time_left)
    fields = {"state": state, "episode": episode, "frameRate": frame_rate, **scores, **turn, **times}
    return json.dumps({**fields, **session} if session else fields)


def seconds(**times: float | None) -> dict[str, float]:
    """Return the times, in seconds, for a message: rounded to milliseconds, without times that are None or infinite."""
    return {name: round(time, 3) for name, time in times.items() if time is not None and time < math.inf}


def _turn(to_act: bool | None, ends_in: float | None, chosen: str | None, time_up: str | None) -> dict[str, Any]:
    fields = {"toAct": to_act, "chosen": chosen, "timeUp": time_up}
    return {name: value for name, value in fields.items() if value is not None} | seconds(turnEndsIn=ends_in)


def _scores(score: float, episode_score: float, next_in: float | None) -> dict[str, float]:
    return {"score": tidy(score), "episodeScore": tidy(episode_score), **seconds(nextIn=next_in)}


def done(episodes: int, score: float, outcome: str | None = None, words: str | None = None) -> str:
    """Build the message that says that the trial is over. `outcome`: in a session, how it has ended for this member.

    `words`: a sentence that the participant must be able to read at the end, such as what went wrong.
    """
    fields: dict[str, Any] = {"done": True, "episodes": episodes, "score": tidy(score)}
    fields |= {} if outcome is None else {"outcome": outcome}
    return json.dumps(fields if words is None else {**fields, "error": words})


def error(words: str) -> str:
    """Build the message that shows a sentence to the participant, such as what went wrong."""
    return json.dumps({"error": words})


def tidy(score: float) -> float | int:
    """Return a score for JSON: 340 instead of 340.0, six decimals at most, and 0 for NaN and infinities."""
    if not math.isfinite(score):
        return 0
    return int(score) if float(score).is_integer() else round(score, 6)
