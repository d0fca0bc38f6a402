"""Sections in `trial` of config.yml: `ui`, the page's controls; `scene`, a game drawn by objects; `chat`, who talks."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

from hippodrome.protocol import section_keys as keyed
from hippodrome.protocol import values
from hippodrome.protocol.section_keys import Section, map_of
from hippodrome.protocol.values import MAX_NAME, KeyPath, SectionProblem, checked, is_blank

RESERVED_CONTROLS = frozenset({"toggle", "faster", "slower", "requestUI"})
"""Words that clients send to the server, so none of the project's own controls can have these names."""
MAX_OWN_CONTROLS = 32

_CONTROL = values.text("the name of a control", MAX_NAME)


def _own_controls(others: dict[str, Any], path: KeyPath) -> tuple[tuple[str, ...], list[SectionProblem]]:
    """The names of the project's own controls in `ui` that are to be shown, in the order of the file."""
    controls: list[str] = []
    problems: list[SectionProblem] = []
    for name, value in others.items():
        here = (*path, name)
        shown, wrong = (False, []) if is_blank(value) else checked(values.flag, value, here)
        if shown and name in RESERVED_CONTROLS:
            wrong = [SectionProblem(here, "the game's server knows this word already; give the control another name")]
        elif shown:
            _, wrong = checked(_CONTROL, name, here)
        if shown and not wrong:
            controls.append(name)
        problems += wrong
    if len(controls) > MAX_OWN_CONTROLS:
        sentence = f"must have at most {MAX_OWN_CONTROLS} controls of your own, not {len(controls)}"
        problems.insert(0, SectionProblem(path, sentence))
    return tuple(controls), problems


def _control() -> Any:
    return keyed.key(values.flag, False, "", {"type": "boolean"})


@dataclass(frozen=True, slots=True)
class Ui(Section):
    """The section `ui`: the controls that the game page shows. Controls that the section does not name are hidden."""

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
    own: tuple[str, ...] = keyed.others(
        _own_controls,
        {
            "additionalProperties": {
                "type": ["boolean", "null"],
                "description": "A control of your own: a button with this name; a press calls feedback(name) of the "
                "agent.",
            },
            "patternProperties": {  # and not `properties`, whose names editors propose
                f"^({'|'.join(sorted(RESERVED_CONTROLS))})$|^.{{{MAX_NAME + 1},}}$": {"enum": [False, None]}
            },
        },
    )
    """The project's own controls: all other keys that are true. A press calls feedback(name) of the agent."""

    def shown(self) -> tuple[str, ...]:
        """Return the names of all controls that are shown, the project's own last."""
        return tuple(name for name, shown in keyed.document(self).items() if shown)


_COLOR = re.compile(r"#[0-9a-fA-F]{6}")
_FOLDER = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]*(?:/[A-Za-z0-9_][A-Za-z0-9._-]*)*")


def _color(value: object) -> str:
    """Check a color of the form `#rrggbb`, and return it in small letters."""
    color = values.as_text(value, 'a color such as "#ffffff", in quotes')
    if not _COLOR.fullmatch(color):
        raise ValueError(f'must be a color such as "#ffffff", in quotes, not {values.show(value)}')
    return color.lower()


def _folder(value: object) -> str:
    """Check the name of a folder in the project's folder."""
    folder = values.as_text(value, "a folder of the project").rstrip("/").removeprefix("./")
    if len(folder) > 200 or not _FOLDER.fullmatch(folder):
        raise ValueError(f"must be a folder of the project, such as assets, not {values.show(value)}")
    return folder


def _pixels(default: int, meaning: str) -> Any:
    return keyed.whole(1, 4096, default, meaning)


@dataclass(frozen=True, slots=True)
class SceneSection(Section):
    """The section `scene`: the picture of a game that is drawn by objects (docs/objects.md)."""

    width: int = _pixels(
        600, "Width of the picture, in pixels of its own. The page shows it larger or smaller, as there is room."
    )
    height: int = _pixels(400, "Height of the picture.")
    background: str = keyed.key(
        _color,
        "#ffffff",
        "The color behind all objects.",
        {"type": "string", "pattern": "^#[0-9a-fA-F]{6}$"},
        kind='`"#rrggbb"`, in quotes',
    )
    coordinates: str = keyed.choice(
        ("relative", "pixels"),
        "`relative`: x, y and points are shares of the picture, so that 0.5 is its middle. `pixels`: "
        "they are pixels of it.",
    )
    pixel_art: bool = keyed.flag(False, "Whether images keep hard edges when they are made larger.")
    assets: str = keyed.text(
        "assets", "The project's folder with the images that sprites show.", _folder, kind="a folder of the project"
    )


MAX_LINE = 1000
"""The most characters of a line that a participant says, whatever the project allows."""
MAX_PHRASES = 100
AI = "ai"
"""The name for which the agent speaks, unless `with` has another that no participant plays."""

_names_shown = map_of(str, values.text("what participants read", MAX_NAME), MAX_PHRASES)
_SPEAKER = values.text("the name of a player, or of who speaks for the agent", MAX_NAME)


def chat(value: object) -> object:
    """Check that this is the section `chat`; `true` is a section with the default of each key, and `false` is none."""
    try:
        return {} if values.flag(value) else None
    except ValueError:
        return values.section("with: [ai]")(value)


@dataclass(frozen=True, slots=True)
class ChatSection(Section):
    """The section `chat`: what participants type, and read, beside the game (docs/talk.md)."""

    partners: tuple[str, ...] = keyed.items(
        "name",
        20,
        _SPEAKER,
        (),
        "To whom participants talk: players of the environment, or another name, for which your agent "
        "speaks. Two participants read each other if one of them is named.",
        name="with",
        single=True,
        kind="list of names",
        otherwise="the other participants; `ai` if there are none",
        example="[ai]",
    )
    max_length: int = keyed.whole(1, MAX_LINE, 500, "The most characters of a participant's line.", example="200")
    turns: str = keyed.choice(
        ("free", "alternate"),
        "`free`: everybody speaks at any time. `alternate`: one after the other, one line each.",
        example="alternate",
    )
    typing: bool = keyed.flag(
        True, "Whether participants may type. If not, they have the `phrases` alone.", example="false"
    )
    phrases: tuple[str, ...] = keyed.items(
        "phrase",
        MAX_PHRASES,
        values.text("a phrase", MAX_LINE),
        (),
        "Lines that have a button.",
        kind="list of texts",
        otherwise="none",
        example='["Need onions", "Wait!"]',
    )
    first: str | None = keyed.key(
        _SPEAKER,
        None,
        "Who speaks first. If it is the agent's name, its [`reply`](callbacks.md#talk) is asked for a "
        'first line, with the text `""`.',
        {"type": "string"},
        kind="a name of `with`, or a player",
        otherwise="with `alternate` the first player, else anybody",
        example="ai",
    )
    names: dict[str, str] = keyed.texts(  # noqa: RUF009 - it returns a field
        "ai: Robo",
        "What participants read instead of these names.",
        _names_shown,
        kind="a map: the name and a text of at most 64 letters",
        otherwise="`playerNames`, or the names",
        example="{ai: Robo}",
    )
