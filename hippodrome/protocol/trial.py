"""The `trial` section of config.yml: its keys, and their values. `protocol/trial_check.py` checks a section."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.protocol import keyboard, values
from hippodrome.protocol import players as player_checks
from hippodrome.protocol import section_keys as keyed
from hippodrome.protocol.keys import NAME
from hippodrome.protocol.section_keys import Section
from hippodrome.protocol.trial_llm import LlmSection
from hippodrome.protocol.trial_sections import ChatSection, SceneSection, Ui, chat
from hippodrome.protocol.values import KeyPath, Plain, SectionProblem, checked, number_in, show

RATE_CHANGE, RATE_CHANGE_MISSPELT = "allowFrameRateChange", "allowFramRateChange"  # HIPPO's documentation has both
MAX_EPISODES = 1_000_000
MAX_BREAK = 600
"""Seconds."""
TALK = "talk"
"""The built-in game in which participants only talk."""
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


def _until(value: object) -> object:
    """Check that `until` names success, and return it."""
    if not isinstance(value, dict) or [*value] != ["success"]:
        raise ValueError(f"must be a number of episodes that succeed, such as {{success: 3}}, not {show(value)}")
    return value


def _successes(section: Mapping[Any, Any], path: KeyPath) -> tuple[dict[str, int] | None, list[SectionProblem]]:
    """Check the number of episodes in `until`."""
    number, problems = checked(values.whole(1, MAX_EPISODES), section["success"], (*path, "success"))
    return (None if problems else {"success": number}), problems


def _step(value: object) -> str:
    """Check the name of a step, or the number of a numbered one, and return it."""
    name = value.text if isinstance(value, Plain) else value
    if not isinstance(name, str) or not NAME.fullmatch(name.strip()):
        raise ValueError(f"must be the name of a step, not {show(value)}")
    return name.strip()


def step_names(items: object) -> tuple[str, ...]:
    """Return the names in a checked list of steps as it is written."""
    return tuple(map(_step, items)) if isinstance(items, list | tuple) else ()


def _rate(default: int, meaning: str, **more: Any) -> Any:
    return keyed.whole(1, HIGHEST_RATE, default, meaning, **more)


@dataclass(frozen=True, slots=True)
class TrialSection(Section):
    """The section `trial`: the game and its server."""

    action_buffer_lifespan: int = keyed.whole(
        1,
        10_000,
        1,
        "For how many steps of the environment an action lasts, unless another comes. 1 is no buffer."
        " Some environments ignore actions at random; with 5, hardly any action is lost.",
        example="5",
    )
    max_episodes: int = keyed.whole(
        1, MAX_EPISODES, 20, "Episodes until the trial is over and the participant moves on.", example="3"
    )
    until: dict[str, int] | None = keyed.key(
        _until,
        None,
        'The trial is over as soon as so many episodes have ended with a true `info["success"]`, in all. '
        "`maxEpisodes` stays the most that are played; the answer has `reached`, true or false.",
        {
            "type": ["object", "null"],
            "properties": {"success": {"type": "integer", "minimum": 1, "maximum": MAX_EPISODES}},
            "required": ["success"],
            "additionalProperties": False,
        },
        entries=_successes,
        kind="`{success: n}`",
        example="{success: 3}",
    )
    between_episodes: float | str = keyed.key(
        _break,
        3,
        "Seconds of the break between two episodes, in which the page shows the score and counts "
        "down. The button Start ends the break at once, and so does Space if it is no key of an "
        "action. 0 is no break. Or a page of `steps/`, which is shown until the participant goes on. "
        "See [pages in the game](#pages-in-the-game).",
        {"anyOf": [{"type": "number", "minimum": 0, "maximum": MAX_BREAK}, {"type": "string"}]},
        kind="0 to 600, or name of a page",
        example="pause",
    )
    instructions: str | None = keyed.key(
        page,
        None,
        "A page of `steps/` that the game page shows before the game, and again in a pause. See "
        "[pages in the game](#pages-in-the-game).",
        {"type": "string"},
        kind="name of a page",
        example="rules",
    )
    reset_freeze: float = keyed.seconds(
        60,
        0,
        "Seconds for which each episode shows its first picture, with a countdown, before its first "
        "step. Keys do nothing meanwhile.",
        example="3",
    )
    max_steps: int = keyed.whole(
        0, 10**9, 0, "Steps after which an episode is truncated. 0 is no limit.", example="1000"
    )
    episode_seconds: float = keyed.seconds(
        86_400,
        0,
        "Seconds of play after which an episode is truncated; pauses and the countdown do not count. "
        "The page shows the time that is left. 0 is no limit.",
        example="90",
    )
    keys: dict[str, Any] = keyed.key(
        values.section("ArrowLeft: left"),
        {},
        "What the keys of the keyboard do; see [keys](#keys).",
        {
            "type": "object",
            "additionalProperties": {
                "anyOf": [
                    {"type": ["string", "integer"]},
                    {"type": "object", "additionalProperties": {"type": ["string", "integer"]}},
                ]
            },
        },
        entries=keyboard.actions_of_keys,
        kind="section",
        otherwise="by the actions' names",
        example="{ArrowLeft: left, a: left}",
    )
    labels: dict[str, str] = keyed.texts(
        "left: Go left",
        "Texts of the buttons, by action. An arrow's text stands below the arrow; with `keys`, the "
        "list of keys shows it, too.",
        keyboard.labels,
        kind="section",
        otherwise="the actions' names",
        example="{left: Go left}",
    )
    input: str = keyed.choice(
        ("held", "single"),
        "`held`: an action goes on while its keys are held. `single`: each press of a key is one action, for one step.",
        example="single",
    )
    game: str | None = keyed.key(
        values.text("the name of an environment"),
        None,
        "The name of the environment; your agent's `start()` receives it. If another package "
        "registers it with Gymnasium, its module stands before it: `minigrid:MiniGrid-Empty-5x5-v0`. "
        "`talk` is a built-in game in which people [only talk](talk.md#words-alone).",
        {"type": "string"},
        otherwise="needed if there is a game step",
        example="ALE/Pong-v5",
    )
    data_file: str = keyed.choice(
        ("episode", "trial"),
        "`episode`: a recording after each episode, which needs less memory. `trial`: one at the end.",
        example="trial",
    )
    s3upload: bool = keyed.flag(
        True, "Whether recordings are kept. If not, they are lost with the server.", example="false"
    )
    action_space: tuple[str, ...] = keyed.items(
        "action",
        1000,
        values.action_name,
        (),
        "Names of the actions, in the order of the environment's numbers: the first is action 0. See "
        "[actionSpace](#actionspace).",
        kind="list of different texts of at most 64 letters",
        example="[noop, fire, right, left]",
    )
    allow_frame_rate_change: bool = keyed.flag(
        False,
        "Whether participants may change the rate (HIPPO's spelling `allowFramRateChange` is "
        "understood). The next three keys have no effect if participants may not.",
        example="true",
    )
    frame_rate_step_size: int = _rate(
        5, "By how many frames per second `fpsUp` and `fpsDown` change the rate.", example="10"
    )
    min_frame_rate: int = _rate(1, "The lowest rate.", kind="1 to 240, at most `startingFrameRate`", example="5")
    max_frame_rate: int = _rate(90, "The highest rate.", kind="1 to 240, at least `startingFrameRate`", example="60")
    starting_frame_rate: int = _rate(30, "Frames per second when the trial starts.", example="20")
    ui: Ui = keyed.section(
        Ui,
        Ui(left=True, right=True, up=True, down=True, start=True, pause=True),
        "Which controls are shown; see [ui](#ui).",
        otherwise="`left`, `right`, `up`, `down`, `start` and `pause`; with `game: talk` only `start`",
    )
    record_observations: bool = keyed.flag(
        False,
        "Whether recordings hold the full observations, which can be very large. HIPPO saved them "
        "always, so `hippodrome check` remarks on it in a project of HIPPO's layout.",
        example="true",
    )
    lossless: bool = keyed.flag(
        False,
        "Whether every frame shows participants the exact pixels. If not, moving textures are sent as"
        " JPEGs; see [agent.md](agent.md#pictures).",
        example="true",
    )
    callback_seconds: float = keyed.seconds(
        10,
        0.5,
        "How many seconds the game waits for each of the agent's [callbacks](callbacks.md). Then it "
        "goes on without waiting.",
        example="2",
    )
    gym: str = keyed.choice(
        ("none", "watch", "advise"),
        "What programs that have the server's token may do at its path `/gym` while a person plays: "
        "nothing; `watch`: see each step as it is recorded; `advise`: also suggest actions "
        "([gym.md](gym.md#watching-a-trial-and-advising)).",
        example="watch",
    )
    scene: SceneSection | None = keyed.section(
        SceneSection,
        None,
        "The game is drawn by objects that your agent's `render()` returns instead of by frames; see "
        "[objects.md](objects.md#configyml).",
        "width: 600",
        example="{width: 600, height: 400}",
    )
    llm: LlmSection | None = keyed.section(
        LlmSection,
        None,
        "A language model, which talks with participants or answers your agent; see [llm](#llm).",
        "model: small-model-1",
        example="{url: https://api.example.org/v1, model: small-model-1}",
    )
    players: dict[str, Any] = keyed.key(
        player_checks.players,
        {},
        "Who plays each player of an environment that has several: `human`, `random` (a random "
        "possible action), `idle` (the idle action), `agent:Partner` (a class of agent.py), "
        "`policies/partner.onnx` (a file below the project's folder; `sample:policies/partner.onnx` "
        "draws by its output), or `gym://name` (a program at the trial's `/gym`; needs `gym: "
        "advise`). At least one human. If groups differ: one such map for each [group](#steps), by "
        "its number; groups exist only if a page has versions.",
        {
            "type": "object",
            "additionalProperties": {
                "anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]
            },
        },
        kind="a map: the player's name and who plays it",
        otherwise="one human",
        example="{player_0: human, player_1: random}",
    )
    frame_skip: int = keyed.whole(
        1,
        1000,
        1,
        "In real time, policies choose at one step in so many. `policyActions` says what they do between.",
        example="4",
    )
    policy_actions: str | None = keyed.key(
        values.one_of("held", "single"),
        None,
        "In real time, what a policy's player does between two choices, or if the policy is late. "
        "`held`: its last action goes on. `single`: it takes the idle action, so with `frameSkip: 4` "
        "it acts in one step of four.",
        {"enum": ["held", "single"]},
        otherwise="as `input`",
        example="single",
    )
    policy_seconds: float = keyed.seconds(
        600,
        10,
        "With `turns`: the seconds that a policy may think; then the idle action is taken. In real "
        "time it has until the next frame; `policyActions` says what happens if it is late.",
        least=0.01,  # elsewhere 0 means no limit; here it would make each action late
        example="3",
    )
    substitute: str | None = keyed.key(
        player_checks.policy,
        None,
        "With `project.players`: what plays in the place of a participant who is not there. A policy as in `players`.",
        {"type": "string"},
        kind="a policy",
        example="agent:Partner",
        together=True,
    )
    absent: float = keyed.seconds(
        3600,
        30,
        "With `project.players`: seconds for which the game is held when a participant's connection is gone.",
        example="60",
        together=True,
    )
    gather: float = keyed.seconds(
        3600,
        120,
        "With `project.players`: seconds for which those who are there wait, before the game and at a"
        " page between two episodes, for a participant who has not come or who reads on.",
        example="300",
        together=True,
    )
    after_absent: str = keyed.choice(
        ("end", "policy"),
        "What happens when `absent` or `gather` is over: the game ends for all, or `substitute` plays"
        " until the participant is back.",
        example="policy",
        together=True,
    )
    countdown: float = keyed.seconds(
        60,
        3,
        "With `project.players`: seconds from when all are there until the game begins.",
        example="5",
        together=True,
    )
    max_ping: int = keyed.whole(
        0,
        10_000,
        0,
        "With `project.players`: milliseconds that a participant's round trip to the server may take,"
        " measured before the game; 0 is no limit.",
        example="250",
        together=True,
    )
    ping_samples: int = keyed.whole(
        1,
        100,
        5,
        "How many round trips are measured before the game; their median counts. They take [20 "
        "seconds](players.md#several-participants) at most.",
        example="10",
        together=True,
    )
    player_names: dict[str, str] = keyed.texts(
        "red: The red one",
        "With `project.players`: what participants read instead of the names that the environment has for its players.",
        keyboard.player_names,
        kind="a map: the player's name and a text of at most 64 letters",
        otherwise="the names, with a capital",
        example="{agent_left: Red, agent_right: Blue}",
        together=True,
    )
    seed: int | None = keyed.whole(
        0,
        2**31 - MAX_EPISODES - 1,  # so that the last episode's seed, too, is below 2**31
        None,
        "Seed of the first episode; each later episode has the next number. Without this key, each "
        "episode has a random seed. Recordings hold the seeds in both cases.",
        otherwise="random",
        example="7",
    )
    pace: str = keyed.choice(
        ("realtime", "turns"),
        "`realtime`: a step at each frame. `turns`: the game waits until all players who are to act "
        "have chosen; a step comes no sooner than one frame after the last step.",
        example="turns",
    )
    turn_seconds: float = keyed.seconds(
        86_400,
        0,
        "With `turns`: the seconds in which a participant must choose. A pause stops the clock. 0 is no limit.",
        example="20",
    )
    turn_ends: str = keyed.choice(
        ("idle", "random", "episode"),
        "What happens when `turnSeconds` are over: the idle action is taken, a random possible one, "
        "or the episode ends. The page tells the participant.",
        example="random",
    )
    idle_action: str | dict[str, str] | None = keyed.key(
        player_checks.idle_action,
        None,
        "Name of the action that is taken while no key is pressed, or a map of one for each player.",
        {"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": {"type": "string"}}]},
        kind="a name of `actionSpace`, or a map by player",
        otherwise="`noop`, else the first",
        example="stay",
    )
    answers: tuple[str, ...] = keyed.items(
        "step",
        100,
        _step,
        (),
        "Earlier steps whose answers your agent reads, such as beliefs about a partner; see "
        "[callbacks.md](callbacks.md#earlier-answers). It can read no others.",
        kind="list of names of steps",
        otherwise="none",
        example="[beliefs]",
    )
    options: dict[str, Any] = keyed.key(
        values.options,
        {},
        "Settings of your own for your agent; see [options](#options).",
        {"type": "object"},
        kind="section of your own keys",
        example="{difficulty: 3}",
    )
    chat: ChatSection | None = keyed.key(
        chat,
        None,
        "Participants talk to each other, or to your agent; see [talk.md](talk.md). `chat: true` is all defaults.",
        {"anyOf": [{"type": "boolean"}, {"$ref": "#/$defs/ChatSection"}]},
        section=ChatSection,
        kind="section, or `true`",
        otherwise="nobody talks",
        example="{with: [ai]}",
    )

    def as_talk(self) -> TrialSection:
        """Return the section of the game `talk`, with its defaults: one episode, a step each second, `chat`, and no
        control but `start`: a pause by one participant would stop the clock of all."""
        rate = self.starting_frame_rate if self.given("startingFrameRate") else 1
        episodes = self.max_episodes if self.given("maxEpisodes") else 1
        chat = self.chat or ChatSection()
        ui = self.ui if self.given("ui") else Ui(start=True)
        return dataclasses.replace(self, starting_frame_rate=rate, max_episodes=episodes, chat=chat, ui=ui)

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
        page_names = {"instructions": self.instructions, "betweenEpisodes": self.between_episodes}
        return {key: page for key, page in page_names.items() if isinstance(page, str)}

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
        return any(isinstance(action, dict) for action in self.keys.values())

    def key_maps(self) -> Iterator[tuple[KeyPath, Mapping[str, str]]]:
        """Yield `keys`, or the map in it for each player, after its path below `keys`."""
        if self.keys_differ:
            yield from (((player,), key_map) for player, key_map in self.keys.items())
        else:
            yield (), self.keys

    def player_maps(self) -> Iterator[tuple[KeyPath, Mapping[str, str]]]:
        """Yield `players`, or the map in it for each group, after its path below `players`."""
        if player_checks.by_group(self.players):
            yield from (((group,), player) for group, player in self.players.items())
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
        """Return the section as a registration stores it: as `document`, without SESSION_KEYS, `chat` and `llm` if they
        have their default values, since ECS limits the length of a server's variables."""
        defaults, left_out = TrialSection().document(), (*SESSION_KEYS, "chat", "llm")
        return {key: value for key, value in self.document().items() if key not in left_out or value != defaults[key]}


SESSION_KEYS = tuple(key.name for key in keyed.keys(TrialSection) if key.together)
"""Keys of games of several participants (`project.players`). A registration leaves out a key with its default value."""
