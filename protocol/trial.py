"""The `trial` section of config.yml: its keys, and what each may be. `protocol/trial_check.py` checks it."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from protocol import key_maps, values
from protocol import players as who
from protocol.values import Check, Keys, Problem, number_in

RATE_CHANGE, RATE_CHANGE_MISSPELT = "allowFrameRateChange", "allowFramRateChange"  # HIPPO's documentation has both
TAKEN = frozenset({"toggle", "faster", "slower", "requestUI"})
"""Words that a client says to the server, so no control of a project's own can be called so."""
MAX_OWN_CONTROLS = 32
OWN_CONTROL = "A control of your own: a button with this name; a press calls feedback(name) of the agent."
MOST_EPISODES = 1_000_000
LONGEST_BREAK = 600
"""Seconds."""
HIGHEST_RATE = 240
"""Frames per second that no project may exceed."""


@dataclass(frozen=True)
class Key:
    """A key of a section: its name in the file, and the attribute that holds its value."""

    name: str
    attribute: str
    check: Check
    default: Any
    """What it is if it is not given; None if that is no plain value."""
    meaning: str
    schema: Mapping[str, Any]
    """JSON Schema of the value, for editors."""
    each: Check | None = None
    """If the value is a list: the check of each item."""
    section: type[Ui | Scene] | None = None
    """If the value is a section of its own: the class of its keys."""
    entries: Callable[[Any, Keys], tuple[Any, list[Problem]]] | None = None
    """If the value is a map of names of the project's own: what is good of it at this path, and what is wrong."""


def _about(check: Check, meaning: str, schema: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    return {"check": check, "meaning": meaning, "schema": schema, **more}


def _key(check: Check, default: Any, meaning: str, schema: Mapping[str, Any], **more: Any) -> Any:
    return field(default=default, metadata=_about(check, meaning, schema, **more))


def _flag(default: bool, meaning: str) -> Any:
    return _key(values.flag, default, meaning, {"type": "boolean"})


def _control() -> Any:
    return _key(values.flag, False, "", {"type": "boolean"})


def _whole(low: int, high: int, default: int | None, meaning: str) -> Any:
    schema = {"type": "integer", "minimum": low, "maximum": high}
    return _key(values.whole(low, high), default, meaning, schema)


def _seconds(most: int, default: float, meaning: str, *, least: float = 0) -> Any:
    """Seconds, from `least` on."""
    return _key(values.number(least, most), default, meaning, {"type": "number", "minimum": least, "maximum": most})


def _choice(words: tuple[str, ...], meaning: str) -> Any:
    """One of these words; the first is the default."""
    return _key(values.one_of(*words), words[0], meaning, {"enum": list(words)})


def _rate(default: int, meaning: str) -> Any:
    return _whole(1, HIGHEST_RATE, default, meaning)


@dataclass(frozen=True, slots=True)
class Ui:
    """Which controls the game page shows. If the section is given, what it does not name is not shown."""

    left: bool = _control()
    right: bool = _control()
    up: bool = _control()
    down: bool = _control()
    start: bool = _control()
    stop: bool = _control()
    pause: bool = _control()
    reset: bool = _control()
    train_offline: bool = _control()
    train_online: bool = _control()
    good: bool = _control()
    bad: bool = _control()
    fps_set: bool = _control()
    fps_up: bool = _control()
    fps_down: bool = _control()
    own: tuple[str, ...] = ()
    """The project's own controls: all other keys that are true. A press is a word for the agent."""

    def shown(self) -> tuple[str, ...]:
        """The names of all controls that are shown, the project's own last."""
        return tuple(name for name, shown in _document(self).items() if shown)


def _usual_ui() -> Ui:
    return Ui(left=True, right=True, up=True, down=True, start=True, pause=True)


_COLOR = re.compile(r"#[0-9a-fA-F]{6}")
_FOLDER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(?:/[A-Za-z0-9_][A-Za-z0-9._-]*)*")


def _color(value: object) -> str:
    """A color of the form `#rrggbb`, in small letters."""
    found = values.as_text(value, 'a color such as "#ffffff", in quotes')
    if not _COLOR.fullmatch(found):
        raise ValueError(f'must be a color such as "#ffffff", in quotes, not {values.show(value)}')
    return found.lower()


def _folder(value: object) -> str:
    """A folder below the project's."""
    found = values.as_text(value, "a folder of the project").rstrip("/").removeprefix("./")
    if len(found) > 200 or not _FOLDER.fullmatch(found):
        raise ValueError(f"must be a folder of the project, such as assets, not {values.show(value)}")
    return found


def _pixels(default: int, meaning: str) -> Any:
    return _whole(1, 4096, default, meaning)


@dataclass(frozen=True, slots=True)
class Scene:
    """How a game is shown that is drawn by objects (docs/objects.md)."""

    width: int = _pixels(600, "Width of the picture, in pixels of its own; the page makes it larger or smaller.")
    height: int = _pixels(400, "Its height.")
    background: str = _key(
        _color,
        "#ffffff",
        "Color behind all objects, as #rrggbb in quotes.",
        {"type": "string", "pattern": "^#[0-9a-fA-F]{6}$"},
    )
    coordinates: str = _choice(
        ("relative", "pixels"),
        "Whether x, y and points are shares of the picture, from 0 to 1, or pixels of it.",
    )
    pixel_art: bool = _flag(False, "Whether images keep hard edges when they are made larger.")
    assets: str = _key(_folder, "assets", "The project's folder with the images that sprites show.", {"type": "string"})


_PAGE = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_ .-]{0,98}[A-Za-z0-9_-])?")


def page(value: object) -> str:
    """A file in the folder of pages, without `.html`. Raises ValueError with what to write."""
    found = values.as_text(value, "the name of a file in the steps folder")
    stem = found.removesuffix(".html")
    if "/" in found or "\\" in found:
        raise ValueError(f"must be the name of a file in the steps folder, without folders, not {values.show(found)}")
    if stem == "game":
        raise ValueError("a page cannot be called game.html; rename it")
    if not _PAGE.fullmatch(stem) or ".." in stem:
        letters = "letters (a to z), digits, spaces, dots, dashes and underscores"
        raise ValueError(f"file names may hold {letters}; rename {values.show(found)}")
    return stem


def _break(value: object) -> float | str:
    """The seconds of a break, or the page that is shown in it."""
    if isinstance(value, str) and number_in(value) is None and value.strip():
        return page(value)
    try:
        return values.number(0, LONGEST_BREAK)(value)  # type: ignore[return-value]
    except ValueError as error:
        raise ValueError(f"{error}; or the name of a file in the steps folder") from None


@dataclass(frozen=True, slots=True)
class Trial:
    """What happens on the participant's server."""

    action_buffer_lifespan: int = _whole(
        1, 10_000, 1, "Environment steps for which an action stays in force unless another comes; 1 is no buffer."
    )
    max_episodes: int = _whole(1, MOST_EPISODES, 20, "Episodes until the trial is over.")
    between_episodes: float | str = _key(
        _break,
        3,
        "Seconds of the break between two episodes, with the score and a countdown; 0 is none. Or a file of steps/, "
        "which is shown until the participant goes on.",
        {"anyOf": [{"type": "number", "minimum": 0, "maximum": LONGEST_BREAK}, {"type": "string"}]},
    )
    instructions: str | None = _key(
        page,
        None,
        "A file of steps/ that the game page shows before the game, and again in a pause.",
        {"type": "string"},
    )
    reset_freeze: float = _seconds(
        60,
        0,
        "Seconds for which each episode shows its first picture, with a countdown; keys do nothing.",
    )
    max_steps: int = _whole(0, 10**9, 0, "Steps after which an episode is truncated; 0 is no limit.")
    episode_seconds: float = _seconds(
        86_400,
        0,
        "Seconds of play after which an episode is truncated; the page shows the time left. 0 is no limit.",
    )
    keys: dict[str, Any] = field(
        default_factory=dict,
        metadata=_about(
            values.section("ArrowLeft: left"),
            "What the keys of the keyboard do: an action by KeyboardEvent.key, or several joined by +; or such a map "
            "for each player. Default: arrows, WASD, Space and digits, by the names of the actions.",
            {
                "type": "object",
                "additionalProperties": {
                    "anyOf": [
                        {"type": ["string", "integer"]},
                        {"type": "object", "additionalProperties": {"type": ["string", "integer"]}},
                    ]
                },
            },
            entries=key_maps.actions_of_keys,
        ),
    )
    labels: dict[str, str] = field(
        default_factory=dict,
        metadata=_about(
            values.section("left: Go left"),
            "Texts of the buttons, by action.",
            {"type": "object", "additionalProperties": {"type": ["string", "number"]}},
            entries=key_maps.labels,
        ),
    )
    input: str = _choice(
        ("held", "single"),
        "Whether an action goes on while its keys are held, or each press of a key is one action.",
    )
    game: str | None = _key(
        values.text("the name of an environment"),
        None,
        "Name of the environment, given to the agent's start(). Needed if there is a game step.",
        {"type": "string"},
    )
    data_file: str = _choice(
        ("episode", "trial"),
        "Whether a recording is written after each episode or once at the end of the trial.",
    )
    s3upload: bool = _flag(True, "Whether recordings are uploaded; otherwise they are lost with the server.")
    action_space: tuple[str, ...] = _key(
        values.items("action", 1000),
        (),
        "Names of the actions, in the order of the environment's numbers.",
        {"type": "array", "items": {"type": "string"}},
        each=values.action_name,
    )
    allow_frame_rate_change: bool = _flag(False, "Whether participants may change the frame rate.")
    frame_rate_step_size: int = _rate(5, "Frames per second by which fpsUp and fpsDown change the rate.")
    min_frame_rate: int = _rate(1, "Lowest rate, in frames per second.")
    max_frame_rate: int = _rate(90, "Highest rate, in frames per second.")
    starting_frame_rate: int = _rate(30, "Rate at which a trial starts, in frames per second.")
    ui: Ui = field(
        default_factory=_usual_ui,
        metadata=_about(
            values.section("bad: …"),
            "Controls on the game page. Default: left, right, up, down, start, pause.",
            {"$ref": "#/$defs/Ui"},
            section=Ui,
        ),
    )
    record_observations: bool = _flag(False, "Whether recordings hold the full observations, which can be large.")
    lossless: bool = _flag(False, "Whether every picture arrives unchanged, however many bytes that takes.")
    callback_seconds: float = _seconds(
        10,
        0.5,
        "Seconds for which the game waits for a callback of the agent; then it goes on without waiting.",
    )
    gym: str = _choice(
        ("none", "watch", "advise", "environments"),
        "What programs that have the server's token may do at its path /gym: nothing, see each step, also advise, or "
        "make environments of their own.",
    )
    scene: Scene | None = field(
        default=None,
        metadata=_about(
            values.section("width: 600"),
            "The game is drawn by objects that render() returns, in a picture of this size. Without it, by frames.",
            {"$ref": "#/$defs/Scene"},
            section=Scene,
        ),
    )
    players: dict[str, Any] = field(
        default_factory=dict,
        metadata=_about(
            who.players,
            "Who plays each player of the environment: human, random, idle, agent:Class of agent.py, an .onnx file, or "
            "gym://name. One such map for each group, by its number, if groups differ. An environment with one player "
            "needs none: it is human.",
            {
                "type": "object",
                "additionalProperties": {
                    "anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]
                },
            },
        ),
    )
    frame_skip: int = _whole(1, 1000, 1, "Policies choose anew at one step in so many.")
    policy_seconds: float = _seconds(
        600,
        10,
        "With pace: turns, the seconds that a policy may think; then the idle action is taken.",
        least=0.01,  # with 0, which elsewhere is no limit, each action would come late
    )
    seed: int | None = _whole(
        0,
        2**31 - MOST_EPISODES - 1,  # the last episode's seed too is below 2**31
        None,
        "Seed of the first episode; each one after it has the next number. Without it, each has a random one.",
    )
    pace: str = _choice(
        ("realtime", "turns"),
        "Whether a step is taken at each frame, or as soon as all have chosen who are to act.",
    )
    turn_seconds: float = _seconds(
        86_400,
        0,
        "With pace: turns, the seconds in which a participant must choose; 0 is no limit.",
    )
    turn_ends: str = _choice(
        ("idle", "random", "episode"),
        "What happens when turnSeconds are over: the idle action, a random possible one, or the episode ends.",
    )
    idle_action: str | dict[str, str] | None = field(
        default=None,
        metadata=_about(
            who.idle_action,
            "Name of the action of no key, or one for each player. Default: noop, if there is one, else the first.",
            {"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]},
        ),
    )
    options: dict[str, Any] = field(
        default_factory=dict,
        metadata=_about(
            values.options,
            "Whatever else the agent wants to know: a map of your own keys; at most 4 KB.",
            {"type": "object"},
        ),
    )

    @property
    def between_seconds(self) -> float:
        """The seconds of a break; infinite if the participant ends it."""
        return math.inf if isinstance(self.between_episodes, str) else self.between_episodes

    @property
    def pages(self) -> Mapping[str, str]:
        """The files of the folder of pages that the game page shows, by the key that names each."""
        named = {"instructions": self.instructions, "betweenEpisodes": self.between_episodes}
        return {key: page for key, page in named.items() if isinstance(page, str)}

    def keys_of(self, player: str) -> Mapping[str, str]:
        """The actions of a player's keys by combination (`protocol.keyboard`); empty if the actions' names decide."""
        return dict(self.key_maps()).get((player,) if self.keys_differ else (), {})

    @property
    def keys_differ(self) -> bool:
        """Whether `keys` has a map for each player."""
        return any(isinstance(each, dict) for each in self.keys.values())

    def key_maps(self) -> Iterator[tuple[Keys, Mapping[str, str]]]:
        """The maps in `keys`, each with its path below `keys`: that of all players, or one for each."""
        if self.keys_differ:
            yield from (((player,), each) for player, each in self.keys.items())
        else:
            yield (), self.keys

    def players_of(self, group: int | None) -> dict[str, str]:
        """What plays each player in this group; empty if the section does not say."""
        if who.by_group(self.players):
            return dict(self.players.get(str(self.groups()[0] if group is None else group), {}))
        return dict(self.players)

    def groups(self) -> tuple[int, ...]:
        """The groups that `players` names; empty if it does not differ between groups."""
        return tuple(map(int, self.players)) if who.by_group(self.players) else ()

    def player_names(self) -> tuple[str, ...]:
        """The players that `players` names, in any group."""
        tables = self.players.values() if who.by_group(self.players) else [self.players]
        return tuple(dict.fromkeys(name for table in tables for name in table))

    def document(self) -> dict[str, Any]:
        """The section with every default filled in, as JSON has it. `check` accepts it unchanged."""
        return _document(self)


def _document(section: Trial | Ui | Scene) -> dict[str, Any]:
    document = {
        key.name: _plain(getattr(section, key.attribute), key.section is not None) for key in keys(type(section))
    }
    return document | dict.fromkeys(section.own, True) if isinstance(section, Ui) else document


def _plain(value: Any, section: bool) -> Any:
    if section and value is not None:
        return _document(value)
    return list(value) if isinstance(value, tuple) else value


def keys(section: type[Trial | Ui | Scene]) -> tuple[Key, ...]:
    """The keys of `Trial`, `Ui` or `Scene`, in order."""
    found = []
    for each in dataclasses.fields(section):
        if not each.metadata:
            continue
        default = None if each.default is dataclasses.MISSING else each.default
        found.append(Key(name=_camel(each.name), attribute=each.name, default=default, **each.metadata))
    return tuple(found)


def names(section: type[Trial | Ui | Scene]) -> frozenset[str]:
    """The names of the keys as they stand in the file."""
    return frozenset(key.name for key in keys(section))


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(other.capitalize() for other in others)
