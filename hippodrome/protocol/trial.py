"""The `trial` section of config.yml: its keys, and their values. `protocol/trial_check.py` checks a section."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.protocol import key_maps, values
from hippodrome.protocol import players as player_checks
from hippodrome.protocol import section_keys as keyed
from hippodrome.protocol.section_keys import Section
from hippodrome.protocol.trial_sections import SceneSection, Ui
from hippodrome.protocol.values import KeyPath, number_in

RATE_CHANGE, RATE_CHANGE_MISSPELT = "allowFrameRateChange", "allowFramRateChange"  # HIPPO's documentation has both
SESSION_KEYS = ("substitute", "absent", "gather", "afterAbsent", "countdown", "maxPing", "pingSamples", "playerNames")
"""Keys of games of several participants (`project.players`). A registration leaves out a key with its default value."""
MAX_EPISODES = 1_000_000
MAX_BREAK = 600
"""Seconds."""
HIGHEST_RATE = 240
"""The highest frame rate of any project, in frames per second."""


def page(value: object) -> str:
    """Return the name of a file in the folder of pages, without `.html`. Raises ValueError with what to write."""
    stem = values.step_file(values.as_text(value, "the name of a file in the steps folder"))
    if stem == "game":
        raise ValueError("a page cannot be called game.html; rename it")
    return stem


def _break(value: object) -> float | str:
    """Check `betweenEpisodes` and return the seconds of a break, or the page that the break shows."""
    if isinstance(value, str) and number_in(value) is None and value.strip():
        return page(value)
    try:
        return values.number(0, MAX_BREAK)(value)  # type: ignore[return-value]
    except ValueError as error:
        raise ValueError(f"{error}; or the name of a file in the steps folder") from None


def _rate(default: int, meaning: str) -> Any:
    return keyed.whole(1, HIGHEST_RATE, default, meaning)


@dataclass(frozen=True, slots=True)
class TrialSection(Section):
    """The section `trial`: the game and its server."""

    action_buffer_lifespan: int = keyed.whole(
        1, 10_000, 1, "Environment steps for which an action is taken if no other action comes; 1 is no buffer."
    )
    max_episodes: int = keyed.whole(1, MAX_EPISODES, 20, "Episodes until the trial is over.")
    between_episodes: float | str = keyed.key(
        _break,
        3,
        "Seconds of the break between two episodes, with the score and a countdown; 0 is no break. Or a file of "
        "steps/, which the page shows until the participant goes on.",
        {"anyOf": [{"type": "number", "minimum": 0, "maximum": MAX_BREAK}, {"type": "string"}]},
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
    keys: dict[str, Any] = keyed.key(
        values.section("ArrowLeft: left"),
        {},
        "The action of each key of the keyboard, by KeyboardEvent.key, with + between keys that are held together; "
        "or such a map for each player. Default: arrows, WASD, Space and digits, by the names of the actions.",
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
    )
    labels: dict[str, str] = keyed.texts("left: Go left", "Texts of the buttons, by action.", key_maps.labels)
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
    action_space: tuple[str, ...] = keyed.items(
        "action", 1000, values.action_name, (), "Names of the actions, in the order of the environment's numbers."
    )
    allow_frame_rate_change: bool = keyed.flag(False, "Whether participants may change the frame rate.")
    frame_rate_step_size: int = _rate(5, "Frames per second by which fpsUp and fpsDown change the rate.")
    min_frame_rate: int = _rate(1, "Lowest rate, in frames per second.")
    max_frame_rate: int = _rate(90, "Highest rate, in frames per second.")
    starting_frame_rate: int = _rate(30, "Rate at which a trial starts, in frames per second.")
    ui: Ui = keyed.section(
        Ui,
        Ui(left=True, right=True, up=True, down=True, start=True, pause=True),
        "Controls on the game page. Default: left, right, up, down, start, pause.",
    )
    record_observations: bool = keyed.flag(False, "Whether recordings hold the full observations, which can be large.")
    lossless: bool = keyed.flag(False, "Whether every picture arrives unchanged, however many bytes that takes.")
    callback_seconds: float = keyed.seconds(
        10,
        0.5,
        "Seconds for which the game waits for a callback of the agent; then it goes on without waiting.",
    )
    gym: str = keyed.choice(
        ("none", "watch", "advise"),
        "What programs with the server's token may do at its path /gym: nothing, watch each step, or also advise.",
    )
    scene: SceneSection | None = keyed.section(
        SceneSection,
        None,
        "With this section the game is drawn by the objects that render() returns, without it by frames.",
        "width: 600",
    )
    players: dict[str, Any] = keyed.key(
        player_checks.players,
        {},
        "Who plays each player of the environment: human, random, idle, agent:Class of agent.py, an .onnx file, or "
        "gym://name. If groups differ, one such map for each group, by its number. Default: human, in an "
        "environment with one player.",
        {
            "type": "object",
            "additionalProperties": {
                "anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]
            },
        },
    )
    frame_skip: int = keyed.whole(1, 1000, 1, "In real time, the steps from one choice of a policy to its next.")
    policy_actions: str | None = keyed.key(
        values.one_of("held", "single"),
        None,
        "In real time, whether a policy's action goes on until its next choice, or is one action for one step. "
        "Default: as input.",
        {"enum": ["held", "single"]},
    )
    policy_seconds: float = keyed.seconds(
        600,
        10,
        "With pace: turns, the seconds that a policy has for its choice; then the idle action is taken.",
        least=0.01,  # elsewhere 0 means no limit; here it would make each action late
    )
    substitute: str | None = keyed.key(
        player_checks.policy,
        None,
        "The policy, as in players, that plays in the place of an absent participant, if project.players is 2 or more.",
        {"type": "string"},
    )
    absent: float = keyed.seconds(
        3600,
        30,
        "In a game of several participants, seconds for which the game is held when a participant is disconnected.",
    )
    gather: float = keyed.seconds(
        3600,
        120,
        "In a game of several participants, seconds for which the others wait for a participant who has not come or "
        "is still reading, before the game and at a page between two episodes.",
    )
    after_absent: str = keyed.choice(
        ("end", "policy"),
        "What happens when absent or gather is over: the game ends for all, or substitute plays in the place until the "
        "participant is back.",
    )
    countdown: float = keyed.seconds(60, 3, "Seconds from when all participants are there until the game begins.")
    max_ping: int = keyed.whole(
        0,
        10_000,
        0,
        "The longest round trip of a participant to the server before a game of several participants, in "
        "milliseconds; 0 is no limit.",
    )
    ping_samples: int = keyed.whole(1, 100, 5, "Round trips that are measured before the game; their median counts.")
    player_names: dict[str, str] = keyed.texts(
        "red: The red one",
        "Names of players that participants who play together read, instead of the environment's names.",
        key_maps.player_names,
    )
    seed: int | None = keyed.whole(
        0,
        2**31 - MAX_EPISODES - 1,  # so that the last episode's seed, too, is below 2**31
        None,
        "Seed of the first episode; each later episode has the next number. Default: a random seed for each episode.",
    )
    pace: str = keyed.choice(
        ("realtime", "turns"),
        "Whether a step is taken at each frame, or as soon as all players whose turn it is have chosen.",
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
    idle_action: str | dict[str, str] | None = keyed.key(
        player_checks.idle_action,
        None,
        "Name of the action that is taken without a key, or one for each player. Default: noop if there is such "
        "an action, otherwise the first action.",
        {"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]},
    )
    options: dict[str, Any] = keyed.key(
        values.options, {}, "A map of your own keys for the agent; at most 4 KB.", {"type": "object"}
    )

    @property
    def between_seconds(self) -> float:
        """The seconds of a break; infinity if the participant ends the break."""
        return math.inf if isinstance(self.between_episodes, str) else self.between_episodes

    @property
    def policies_hold(self) -> bool:
        """Whether, in real time, a policy's action goes on at steps for which the policy has chosen none."""
        return (self.policy_actions or self.input) == "held"

    @property
    def most_steps(self) -> float:
        """The largest number of steps of an episode at `starting_frame_rate`; infinity without a limit."""
        timed = math.ceil(self.episode_seconds * self.starting_frame_rate) or math.inf
        return min(self.max_steps or math.inf, timed)

    @property
    def pages(self) -> Mapping[str, str]:
        """The pages that the game page shows: key of config.yml → name of the file in the folder of pages."""
        named = {"instructions": self.instructions, "betweenEpisodes": self.between_episodes}
        return {key: page for key, page in named.items() if isinstance(page, str)}

    def keys_of(self, player: str) -> Mapping[str, str]:
        """Return the actions of a player's keys by combination (`protocol.keyboard`); {} for the default keys."""
        return self.keys.get(player, {}) if self.keys_differ else self.keys

    def labels_of(self, player: str) -> Mapping[str, str]:
        """Return the texts of a player's buttons, by action.

        Actions that only other players have keys for are left out.
        """
        own = set(self.keys_of(player).values())
        others = {action for _, keys in self.key_maps() for action in keys.values()} - own
        return {action: text for action, text in self.labels.items() if action not in others}

    @property
    def keys_differ(self) -> bool:
        """Whether `keys` has a map for each player."""
        return any(isinstance(each, dict) for each in self.keys.values())

    def key_maps(self) -> Iterator[tuple[KeyPath, Mapping[str, str]]]:
        """Yield `keys`, or the map in it for each player, after its path below `keys`."""
        if self.keys_differ:
            yield from (((player,), each) for player, each in self.keys.items())
        else:
            yield (), self.keys

    def player_maps(self) -> Iterator[tuple[KeyPath, Mapping[str, str]]]:
        """Yield `players`, or the map in it for each group, after its path below `players`."""
        if player_checks.by_group(self.players):
            yield from (((group,), each) for group, each in self.players.items())
        else:
            yield (), self.players

    def humans(self) -> Iterator[tuple[KeyPath, list[str]]]:
        """Yield the players that participants play, after the path of their map below `players`.

        There is one map for all groups, or a map for each group.
        """
        for path, players in self.player_maps():
            yield path, [name for name, plays in players.items() if plays == player_checks.HUMAN]

    def players_of(self, group: int | None) -> dict[str, str]:
        """Return what plays each player in this group; {} if the section does not say.

        If there is a map for each group, None stands for the first group.
        """
        if player_checks.by_group(self.players):
            return dict(self.players.get(str(self.groups()[0] if group is None else group), {}))
        return dict(self.players)

    def groups(self) -> tuple[int, ...]:
        """Return the groups that `players` names; () if it has one map for all groups."""
        return tuple(map(int, self.players)) if player_checks.by_group(self.players) else ()

    def named_players(self) -> tuple[str, ...]:
        """Return the players that `players` names in any group, each once."""
        return tuple(dict.fromkeys(name for _, players in self.player_maps() for name in players))

    def policy_files(self) -> Iterator[tuple[tuple[str, ...], str]]:
        """Yield the policies' files that `players` and `substitute` name, each after its path of keys."""
        yield from player_checks.files({"players": self.players, "substitute": self.substitute})

    def document(self) -> dict[str, Any]:
        """Return the section as JSON, with every default filled in. `trial_check.check` accepts it unchanged."""
        return keyed.document(self)

    def registered(self) -> dict[str, Any]:
        """Return the section as a registration stores it: as `document`, without SESSION_KEYS that have their default
        values, since ECS limits the length of a server's variables."""
        defaults = TrialSection().document()
        return {key: each for key, each in self.document().items() if key not in SESSION_KEYS or each != defaults[key]}
