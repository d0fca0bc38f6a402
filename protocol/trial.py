"""The `trial` section of config.yml: its keys, and what each may be. `protocol/trial_check.py` checks it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from protocol import key_maps, values
from protocol import players as who
from protocol import trial_keys as keyed
from protocol.trial_sections import SceneSection, Ui, usual_ui
from protocol.values import Keys, number_in

RATE_CHANGE, RATE_CHANGE_MISSPELT = "allowFrameRateChange", "allowFramRateChange"  # HIPPO's documentation has both
TAKEN = frozenset({"toggle", "faster", "slower", "requestUI"})
"""Words that a client says to the server, so no control of a project's own can be called so."""
MAX_OWN_CONTROLS = 32
OWN_CONTROL = "A control of your own: a button with this name; a press calls feedback(name) of the agent."
SESSION_KEYS = ("substitute", "absent", "gather", "afterAbsent", "countdown", "maxPing", "pingSamples", "playerNames")
"""Keys of games of several participants (`project.players`). A registration leaves out what is as by default."""
MOST_EPISODES = 1_000_000
LONGEST_BREAK = 600
"""Seconds."""
HIGHEST_RATE = 240
"""Frames per second that no project may exceed."""


def page(value: object) -> str:
    """A file in the folder of pages, without `.html`. Raises ValueError with what to write."""
    stem = values.step_file(values.as_text(value, "the name of a file in the steps folder"))
    if stem == "game":
        raise ValueError("a page cannot be called game.html; rename it")
    return stem


def _break(value: object) -> float | str:
    """The seconds of a break, or the page that is shown in it."""
    if isinstance(value, str) and number_in(value) is None and value.strip():
        return page(value)
    try:
        return values.number(0, LONGEST_BREAK)(value)  # type: ignore[return-value]
    except ValueError as error:
        raise ValueError(f"{error}; or the name of a file in the steps folder") from None


def _rate(default: int, meaning: str) -> Any:
    return keyed.whole(1, HIGHEST_RATE, default, meaning)


@dataclass(frozen=True, slots=True)
class TrialSection:
    """What happens on the participant's server."""

    action_buffer_lifespan: int = keyed.whole(
        1, 10_000, 1, "Environment steps for which an action stays in force unless another comes; 1 is no buffer."
    )
    max_episodes: int = keyed.whole(1, MOST_EPISODES, 20, "Episodes until the trial is over.")
    between_episodes: float | str = keyed.key(
        _break,
        3,
        "Seconds of the break between two episodes, with the score and a countdown; 0 is none. Or a file of steps/, "
        "which is shown until the participant goes on.",
        {"anyOf": [{"type": "number", "minimum": 0, "maximum": LONGEST_BREAK}, {"type": "string"}]},
    )
    instructions: str | None = keyed.key(
        page,
        None,
        "A file of steps/ that the game page shows before the game, and again in a pause.",
        {"type": "string"},
    )
    reset_freeze: float = keyed.seconds(
        60,
        0,
        "Seconds for which each episode shows its first picture, with a countdown; keys do nothing.",
    )
    max_steps: int = keyed.whole(0, 10**9, 0, "Steps after which an episode is truncated; 0 is no limit.")
    episode_seconds: float = keyed.seconds(
        86_400,
        0,
        "Seconds of play after which an episode is truncated; the page shows the time left. 0 is no limit.",
    )
    keys: dict[str, Any] = field(
        default_factory=dict,
        metadata=keyed.about(
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
        metadata=keyed.texts("left: Go left", "Texts of the buttons, by action.", key_maps.labels),
    )
    input: str = keyed.choice(
        ("held", "single"),
        "Whether an action goes on while its keys are held, or each press of a key is one action.",
    )
    game: str | None = keyed.key(
        values.text("the name of an environment"),
        None,
        "Name of the environment, given to the agent's start(). Needed if there is a game step.",
        {"type": "string"},
    )
    data_file: str = keyed.choice(
        ("episode", "trial"),
        "Whether a recording is written after each episode or once at the end of the trial.",
    )
    s3upload: bool = keyed.flag(True, "Whether recordings are uploaded; otherwise they are lost with the server.")
    action_space: tuple[str, ...] = keyed.key(
        values.items("action", 1000),
        (),
        "Names of the actions, in the order of the environment's numbers.",
        {"type": "array", "items": {"type": "string"}},
        each=values.action_name,
    )
    allow_frame_rate_change: bool = keyed.flag(False, "Whether participants may change the frame rate.")
    frame_rate_step_size: int = _rate(5, "Frames per second by which fpsUp and fpsDown change the rate.")
    min_frame_rate: int = _rate(1, "Lowest rate, in frames per second.")
    max_frame_rate: int = _rate(90, "Highest rate, in frames per second.")
    starting_frame_rate: int = _rate(30, "Rate at which a trial starts, in frames per second.")
    ui: Ui = field(
        default_factory=usual_ui,
        metadata=keyed.about(
            values.section("bad: …"),
            "Controls on the game page. Default: left, right, up, down, start, pause.",
            {"$ref": "#/$defs/Ui"},
            section=Ui,
        ),
    )
    record_observations: bool = keyed.flag(False, "Whether recordings hold the full observations, which can be large.")
    lossless: bool = keyed.flag(False, "Whether every picture arrives unchanged, however many bytes that takes.")
    callback_seconds: float = keyed.seconds(
        10,
        0.5,
        "Seconds for which the game waits for a callback of the agent; then it goes on without waiting.",
    )
    gym: str = keyed.choice(
        ("none", "watch", "advise", "environments"),
        "What programs that have the server's token may do at its path /gym: nothing, see each step, also advise, or "
        "make environments of their own.",
    )
    scene: SceneSection | None = field(
        default=None,
        metadata=keyed.about(
            values.section("width: 600"),
            "The game is drawn by objects that render() returns, in a picture of this size. Without it, by frames.",
            {"$ref": "#/$defs/SceneSection"},
            section=SceneSection,
        ),
    )
    players: dict[str, Any] = field(
        default_factory=dict,
        metadata=keyed.about(
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
    frame_skip: int = keyed.whole(1, 1000, 1, "Policies choose anew at one step in so many.")
    policy_seconds: float = keyed.seconds(
        600,
        10,
        "With pace: turns, the seconds that a policy may think; then the idle action is taken.",
        least=0.01,  # with 0, which elsewhere is no limit, each action would come late
    )
    substitute: str | None = keyed.key(
        who.policy,
        None,
        "What plays in the place of a participant who is not there, if project.players is 2 or more: a policy as in "
        "players.",
        {"type": "string"},
    )
    absent: float = keyed.seconds(
        3600,
        30,
        "Seconds for which the game is held when a participant's connection is gone, if others play with them.",
    )
    gather: float = keyed.seconds(
        3600,
        120,
        "Seconds for which those who are there wait, before the game and at a page between two episodes, for a "
        "participant who has not come or who reads on, if others play with them.",
    )
    after_absent: str = keyed.choice(
        ("end", "policy"),
        "What happens then: the game ends for all, or substitute plays in the place until the participant is back.",
    )
    countdown: float = keyed.seconds(60, 3, "Seconds from when all participants are there until the game begins.")
    max_ping: int = keyed.whole(
        0,
        10_000,
        0,
        "Milliseconds that a participant's round trip to the server may take before a game of several participants; "
        "0 is no limit.",
    )
    ping_samples: int = keyed.whole(1, 100, 5, "Round trips that are measured before the game; their median counts.")
    player_names: dict[str, str] = field(
        default_factory=dict,
        metadata=keyed.texts(
            "red: The red one",
            "What participants who play together read instead of the players' names in the environment.",
            key_maps.player_names,
        ),
    )
    seed: int | None = keyed.whole(
        0,
        2**31 - MOST_EPISODES - 1,  # the last episode's seed too is below 2**31
        None,
        "Seed of the first episode; each one after it has the next number. Without it, each has a random one.",
    )
    pace: str = keyed.choice(
        ("realtime", "turns"),
        "Whether a step is taken at each frame, or as soon as all have chosen who are to act.",
    )
    turn_seconds: float = keyed.seconds(
        86_400,
        0,
        "With pace: turns, the seconds in which a participant must choose; 0 is no limit.",
    )
    turn_ends: str = keyed.choice(
        ("idle", "random", "episode"),
        "What happens when turnSeconds are over: the idle action, a random possible one, or the episode ends.",
    )
    idle_action: str | dict[str, str] | None = field(
        default=None,
        metadata=keyed.about(
            who.idle_action,
            "Name of the action of no key, or one for each player. Default: noop, if there is one, else the first.",
            {"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]},
        ),
    )
    options: dict[str, Any] = field(
        default_factory=dict,
        metadata=keyed.about(
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
    def most_steps(self) -> float:
        """Steps after which an episode is truncated if nothing holds it up; infinite without a limit."""
        timed = math.ceil(self.episode_seconds * self.starting_frame_rate) or math.inf
        return min(self.max_steps or math.inf, timed)

    @property
    def pages(self) -> Mapping[str, str]:
        """The files of the folder of pages that the game page shows, by the key that names each."""
        named = {"instructions": self.instructions, "betweenEpisodes": self.between_episodes}
        return {key: page for key, page in named.items() if isinstance(page, str)}

    def keys_of(self, player: str) -> Mapping[str, str]:
        """The actions of a player's keys by combination (`protocol.keyboard`); empty if the actions' names decide."""
        return dict(self.key_maps()).get((player,) if self.keys_differ else (), {})

    def labels_of(self, player: str) -> Mapping[str, str]:
        """The texts of a player's buttons by action: not of what the keys of other players do and theirs do not."""
        own = set(self.keys_of(player).values())
        others = {action for _, keys in self.key_maps() for action in keys.values()} - own
        return {action: text for action, text in self.labels.items() if action not in others}

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

    def player_maps(self) -> Iterator[tuple[Keys, Mapping[str, str]]]:
        """The maps in `players`, each with its path below `players`: that of all groups, or one for each."""
        if who.by_group(self.players):
            yield from (((group,), each) for group, each in self.players.items())
        else:
            yield (), self.players

    def humans(self) -> Iterator[tuple[Keys, list[str]]]:
        """The players that participants play, as in `player_maps`."""
        for path, players in self.player_maps():
            yield path, [name for name, plays in players.items() if plays == who.HUMAN]

    def players_of(self, group: int | None) -> dict[str, str]:
        """What plays each player in this group; empty if the section does not say."""
        if who.by_group(self.players):
            return dict(self.players.get(str(self.groups()[0] if group is None else group), {}))
        return dict(self.players)

    def groups(self) -> tuple[int, ...]:
        """The groups that `players` names; empty if it does not differ between groups."""
        return tuple(map(int, self.players)) if who.by_group(self.players) else ()

    def named_players(self) -> tuple[str, ...]:
        """The players that `players` names, in any group."""
        return tuple(dict.fromkeys(name for _, players in self.player_maps() for name in players))

    def document(self) -> dict[str, Any]:
        """The section with every default filled in, as JSON has it. `check` accepts it unchanged."""
        return keyed.document(self)

    def registered(self) -> dict[str, Any]:
        """The section as servers are told it, in few characters: without what of sessions is as by default."""
        usual = TrialSection().document()
        return {key: each for key, each in self.document().items() if key not in SESSION_KEYS or each != usual[key]}
