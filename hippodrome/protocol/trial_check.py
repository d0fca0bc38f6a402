"""Checks a `trial` section: first each value by itself, then the values against each other.

`hippodrome/control/config` calls `check` with the section of a registration, and `hippodrome/trial/settings.py` with a
server's section.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from hippodrome.protocol import values
from hippodrome.protocol.players import GYM_PLAYER
from hippodrome.protocol.section_keys import UNKNOWN_KEY, check_section
from hippodrome.protocol.similar import did_you_mean
from hippodrome.protocol.trial import RATE_CHANGE, RATE_CHANGE_MISSPELT, TALK, TrialSection
from hippodrome.protocol.trial_sections import AI
from hippodrome.protocol.values import SectionProblem, checked, is_blank


def check(section: object) -> tuple[TrialSection, list[SectionProblem]]:
    """Return the values of a `trial` section, and all its problems. Never raises.

    `section` holds JSON values, or texts and `values.Plain`. A key without a value counts as not given. The default
    takes the place of a wrong value. Unknown keys are ignored.
    """
    if is_blank(section):
        return TrialSection(), []
    if not isinstance(section, dict):
        _, problems = checked(values.section("actionBufferLifespan: …"), section, ())
        return TrialSection(), problems
    section, problems = _with_one_spelling(section)
    trial, wrong = check_section(TrialSection, section)
    problems += [problem for problem in wrong if problem.sentence != UNKNOWN_KEY]
    wrong_keys = {path[0] for path, _, _ in problems}
    trial = trial.without(wrong_keys)
    trial = trial.as_talk() if trial.game == TALK else trial
    between_keys = [problem for rule in RULES for problem in rule(trial)]
    return trial, problems + [problem for problem in between_keys if wrong_keys.isdisjoint(problem.compared)]


def _with_one_spelling(section: dict[str, Any]) -> tuple[dict[str, Any], list[SectionProblem]]:
    """The section with the right spelling of `allowFrameRateChange`, which HIPPO's documentation spells in two ways."""
    if RATE_CHANGE_MISSPELT not in section:
        return section, []
    rest = {key: value for key, value in section.items() if key != RATE_CHANGE_MISSPELT}
    if not is_blank(rest.get(RATE_CHANGE)):
        return rest, [SectionProblem((RATE_CHANGE_MISSPELT,), f"{RATE_CHANGE} is given too; keep that one")]
    return rest | {RATE_CHANGE: section[RATE_CHANGE_MISSPELT]}, []


# Rules between keys. A rule gets the section with its defaults. `check` drops a problem if one of the values that it
# compares is wrong by itself.


def _frame_rates(trial: TrialSection) -> Iterator[SectionProblem]:
    """minFrameRate ≤ startingFrameRate ≤ maxFrameRate. The problem is at a key that the file has."""
    rates = {
        "minFrameRate": trial.min_frame_rate,
        "startingFrameRate": trial.starting_frame_rate,
        "maxFrameRate": trial.max_frame_rate,
    }
    low, start, high = rates
    pairs = [(low, high)] if rates[low] > rates[high] else [(low, start), (start, high)]
    for lower, upper in pairs:
        if rates[lower] <= rates[upper]:
            continue
        key = next(key for key in (start, low, high) if key in (lower, upper) and trial.given(key))
        other, bound = (upper, "most") if key == lower else (lower, "least")
        default = "" if trial.given(other) else " by default"
        hint = f"; set {other} too" if default else ""
        sentence = f"must be at {bound} {other}, which is {rates[other]}{default}, not {rates[key]}{hint}"
        yield SectionProblem((key,), sentence, (lower, upper))


def _criterion(trial: TrialSection) -> Iterator[SectionProblem]:
    """`until` can be reached in `maxEpisodes`."""
    if trial.until is not None and trial.until["success"] > trial.max_episodes:
        sentence = f"nobody can reach it in {trial.max_episodes} episodes; write a larger maxEpisodes"
        yield SectionProblem(("until",), sentence, ("until", "maxEpisodes"))


def _actions_that_exist(trial: TrialSection) -> Iterator[SectionProblem]:
    """`keys` and `labels` name only actions of `actionSpace`, if the file has it."""
    names = [action.lower() for action in trial.action_space]
    if not names:
        return
    actions_named = [
        ("keys", (*place, key), action) for place, key_map in trial.key_maps() for key, action in key_map.items()
    ]
    actions_named += [("labels", (action,), action) for action in trial.labels]
    for section, path, action in actions_named:
        if action in names:
            continue
        hint = did_you_mean(action, names) or f"; the actions are {values.printable(', '.join(names), 100)}"
        sentence = f"there is no action {values.show(action)} in actionSpace{hint}"
        yield SectionProblem((section, *path), sentence, ("actionSpace", section))


def _players_that_exist(trial: TrialSection) -> Iterator[SectionProblem]:
    """`keys` by player and `playerNames` name only players of `players`, if the file has it."""
    players_known = trial.named_players()
    players_named = [("keys", player) for player, keys in trial.keys.items() if isinstance(keys, dict)]
    players_named += [("playerNames", player) for player in trial.player_names]
    for section, player in players_named:
        if players_known and player not in players_known:
            sentence = (
                f"there is no such player in players; there are {values.printable(', '.join(players_known), 100)}"
            )
            yield SectionProblem((section, player), sentence, ("players", section))


def _different_actions(trial: TrialSection) -> Iterator[SectionProblem]:
    """`actionSpace` has no name twice."""
    first: dict[str, int] = {}
    for index, action in enumerate(trial.action_space):
        name = action.lower()  # as the trial server writes names
        if first.setdefault(name, index) != index:
            sentence = f"{values.show(action)} is item {first[name] + 1} already; names must differ"
            yield SectionProblem(("actionSpace", index), sentence, ("actionSpace",))


def _programs(trial: TrialSection) -> Iterator[SectionProblem]:
    """A program plays only with `gym: advise`."""
    if trial.gym == "advise":
        return
    for _, players in trial.player_maps():
        for name, plays in players.items():
            if plays.startswith(GYM_PLAYER):
                yield SectionProblem(
                    ("players",), f"{values.printable(name)} is {plays}: write gym: advise too", ("gym",)
                )
                return


def _substitute(trial: TrialSection) -> Iterator[SectionProblem]:
    """`afterAbsent: policy` needs `substitute`."""
    if trial.after_absent == "policy" and trial.substitute is None:
        sentence = "missing; afterAbsent: policy needs a policy that takes the place, such as substitute: random"
        yield SectionProblem(("substitute",), sentence, ("afterAbsent", "substitute"))


def _model(trial: TrialSection) -> Iterator[SectionProblem]:
    """A language model needs an address and a name."""
    if trial.llm is None:
        return
    examples = {"url": "url: https://api.example.org/v1", "model": "model: small-model-1"}
    for key, example in examples.items():
        if not trial.llm.given(key):
            yield SectionProblem(("llm", key), f"missing; write {example}", ("llm",))


def _chat(trial: TrialSection) -> Iterator[SectionProblem]:
    """Participants can say something, each phrase may be said, and who is `first` talks."""
    chat = trial.chat
    if chat is None:
        return
    if not chat.typing and not chat.phrases:
        sentence = "nobody could say anything: write phrases too, or leave typing out"
        yield SectionProblem(("chat", "typing"), sentence, ("chat",))
    for index, phrase in enumerate(chat.phrases):
        if len(phrase) > chat.max_length:
            sentence = f"has {len(phrase)} characters, and maxLength is {chat.max_length}"
            yield SectionProblem(("chat", "phrases", index), sentence, ("chat",))
    players = trial.named_players() or (("player_0",) if trial.game == TALK else ())
    talk = (*players, *(chat.partners or (AI,)))
    if chat.first is not None and (players or chat.partners) and chat.first not in talk:
        hint = did_you_mean(chat.first, talk) or f"; there are {values.printable(', '.join(talk), 100)}"
        yield SectionProblem(
            ("chat", "first"), f"nobody is called {values.show(chat.first)}{hint}", ("chat", "players")
        )


RULES: tuple[Callable[[TrialSection], Iterator[SectionProblem]], ...] = (
    _frame_rates,
    _criterion,
    _different_actions,
    _actions_that_exist,
    _players_that_exist,
    _programs,
    _substitute,
    _model,
    _chat,
)
