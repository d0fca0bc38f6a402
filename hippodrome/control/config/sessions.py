"""Checks of studies in which several participants play in one environment (`project.players`)."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from hippodrome.control.config.config import Config
from hippodrome.control.config.diagnostics import Mistake, Remark
from hippodrome.control.config.each_value import Checked
from hippodrome.protocol.players import HUMAN, by_group
from hippodrome.protocol.trial import SESSION_KEYS, TrialSection
from hippodrome.protocol.values import KeyPath, printable

PLAYERS: KeyPath = ("project", "players")
MATCHING: KeyPath = ("project", "matching")
SEATS: KeyPath = ("project", "seats")
WHO_PLAYS: KeyPath = ("trial", "players")

VERSIONS = "write two versions of a page, such as rules-0.html and rules-1.html"
"""How a study gets groups."""

OF_SESSIONS: tuple[KeyPath, ...] = (
    MATCHING,
    SEATS,
    ("project", "patience"),
    ("project", "afterPatience"),
    *(("trial", key) for key in SESSION_KEYS),
)
"""The keys that have no effect if `project.players` is 1."""


def no_effect(trial: TrialSection) -> str:
    """Return the remark on a key of OF_SESSIONS in a study whose participants play alone."""
    most = max((len(humans) for _, humans in trial.humans()), default=0)
    alone = "project.players is 1, so each participant plays alone"
    return f"no effect: {alone}; write players: {max(2, most)} under project"


def mistakes(checked: Checked) -> Iterator[Mistake]:
    """Yield mistakes in keys that do not fit `project.players`; nothing if each participant plays alone."""
    if not checked.project.has_sessions or not checked.valid(PLAYERS):
        return
    yield from _humans(checked)
    yield from _one_game_for_all(checked)
    yield from _empty_places(checked)
    yield from _seats(checked)
    yield from _of_one_participant(checked)


def mistakes_of_groups(checked: Checked, groups: int) -> Iterator[Mistake]:
    """Yield mistakes in keys that need groups, or name other groups than the study has.

    `groups` is their number: the versions of a page.
    """
    project = checked.project
    if by_group(checked.trial.players) and checked.game_steps and checked.valid(WHO_PLAYS):
        yield from _other_groups(checked.trial.groups(), groups)
    if not project.has_sessions or not checked.valid(PLAYERS, MATCHING) or groups:
        return
    if project.seats == "group" and project.matching == "match" and checked.valid(SEATS):
        yield Mistake(SEATS, f"group, and there are no groups; {VERSIONS}, or seats: match")
    if project.matching in ("group", "mixed"):
        yield Mistake(MATCHING, f"{project.matching}, and there are no groups; {VERSIONS}, or matching: arrival")


def _other_groups(group_numbers: Sequence[int], groups: int) -> Iterator[Mistake]:
    """Yield a mistake if `players` is given group by group, and these are not all groups of the study."""
    if not groups:
        yield Mistake(WHO_PLAYS, f"is given group by group, and there are no groups; {VERSIONS}, or one map for all")
        return
    there = f"there are {groups} groups, 0 to {groups - 1}, since a page has {groups} versions"
    for group in group_numbers:
        if group >= groups:
            message = f"{there}; write a page for this group, such as rules-{group}.html, or leave the group out"
            yield Mistake((*WHO_PLAYS, str(group)), message)
    missing = next((group for group in range(groups) if group not in group_numbers), None)
    if missing is not None:
        yield Mistake(WHO_PLAYS, f"does not say who plays in group {missing}; {there}")


def _humans(checked: Checked) -> Iterator[Mistake]:
    """In each group, the number of human players must be `project.players`."""
    players, trial = checked.project.players, checked.trial
    if not checked.valid(WHO_PLAYS) or not checked.game_steps:
        return
    if not trial.players:
        example = ", ".join(f"player_{index}: {HUMAN}" for index in range(min(players, 2)))
        more = ", …" if players > 2 else ""
        message = f"missing; project.players is {players}, so name the environment's players, {players} of them human"
        yield Mistake(WHO_PLAYS, f"{message}, such as {{{example}{more}}}")
        return
    for path, humans in trial.humans():
        if len(humans) == players:
            continue
        are = f"{len(humans)} players are human" if len(humans) > 1 else "1 player is human"
        advice = f"write human for {players} of them, or players: {len(humans)} under project"
        names = printable(", ".join(humans), 100)
        yield Mistake((*WHO_PLAYS, *path), f"{are} ({names}), and project.players is {players}; {advice}")


def _one_game_for_all(checked: Checked) -> Iterator[Mistake]:
    """`players` may differ between groups only if the participants of each game are of one group."""
    project = checked.project
    if by_group(checked.trial.players) and project.matching != "group" and checked.valid(MATCHING, WHO_PLAYS):
        message = "is given group by group, and a game may have participants of several groups"
        yield Mistake(WHO_PLAYS, f"{message}; write matching: group under project, or one map for all")


def _empty_places(checked: Checked) -> Iterator[Mistake]:
    """`afterPatience: policies` needs `substitute`. (`protocol/trial_check.py` checks `afterAbsent: policy`.)"""
    trial = checked.trial
    needs = checked.project.after_patience == "policies" and trial.after_absent != "policy"
    path: KeyPath = ("trial", "substitute")
    if needs and trial.substitute is None and checked.valid(("project", "afterPatience"), path):
        message = "afterPatience: policies needs a policy that plays in the empty places, such as substitute: random"
        yield Mistake(path, f"missing; {message}")


def _seats(checked: Checked) -> Iterator[Mistake]:
    """`seats` other than `lot` need a `matching` that orders the participants, and a participant for each seat."""
    project = checked.project
    if project.seats == "lot" or not checked.valid(SEATS, MATCHING):
        return
    if project.seats == "match" and project.matching != "match":
        yield Mistake(SEATS, "match, and no function says who plays with whom; write matching: match, or seats: lot")
    elif project.seats == "group" and project.matching not in ("mixed", "match"):
        message = (
            "group, and a game is not of different groups; write matching: mixed or match under project, or seats: lot"
        )
        yield Mistake(SEATS, message)
    elif project.after_patience == "policies" and checked.valid(("project", "afterPatience")):
        message = "and with afterPatience: policies a game may lack participants, whose places are always the last ones"
        yield Mistake(SEATS, f"{project.seats}, {message}; write seats: lot, or afterPatience: unmatched")


def _of_one_participant(checked: Checked) -> Iterator[Mistake]:
    """HIPPO's front end, servers named by userId, and clusters of a participant need participants who play alone."""
    project = checked.project
    if project.plain_clients:
        message = "HIPPO's front end opens the game of one participant: write plainClients: false, or players: 1"
        yield Mistake(("project", "plainClients"), message)
    elif project.subdomain == "userId":
        message = (
            "several participants share a server, so it cannot have the id of one as its name: use subdomain: hash"
        )
        yield Mistake(("project", "subdomain"), message)
    if project.cluster == "participant":
        message = (
            "several participants share a server, so it cannot run in the cluster of one: use cluster: installation"
        )
        yield Mistake(("project", "cluster"), message)


def remarks(config: Config) -> Iterator[Remark]:
    """Yield remarks on a study in which several participants play together."""
    project, trial = config.project, config.trial
    if not project.has_sessions:
        return
    if not config.game_steps:
        yield Remark(PLAYERS, "no effect: no step is game, so no participant plays")
        return
    if project.max_participants is not None and project.max_participants < project.players:
        message = f"below players, which is {project.players}: a participant finds no other to play with"
        yield Remark(("project", "maxParticipants"), message)
    yield from _one_for_all(trial)
    yield from _without_keys(trial)
    yield from _too_short(config)
    if trial.pace == "turns" and not trial.turn_seconds:
        message = "0: a participant who does nothing keeps the others waiting without end; write turnSeconds: 20"
        yield Remark(("trial", "turnSeconds"), message)
    if trial.absent == 0 and trial.after_absent == "end":
        message = "0: a connection that is lost for a moment ends the game for all; write absent: 30"
        yield Remark(("trial", "absent"), message)
    if trial.gather == 0 and trial.after_absent == "end":
        message = "0: the game ends for the first participant who comes, since nobody waits for the others"
        yield Remark(("trial", "gather"), f"{message}; write gather: 120, or afterAbsent: policy with a substitute")


def _without_keys(trial: TrialSection) -> Iterator[Remark]:
    """A remark if `keys` has a map for each player, but none for some human players."""
    humans = dict.fromkeys(name for _, names in trial.humans() for name in names)
    lacking = [name for name in humans if trial.keys_differ and name not in trial.keys]
    if lacking:
        names = printable(", ".join(lacking), 100)
        yield Remark(("trial", "keys"), f"says nothing of {names}: the names of the actions decide their keys")


def _too_short(config: Config) -> Iterator[Remark]:
    """A remark if all episodes and the breaks between them can take longer than a server runs."""
    trial, most = config.trial, config.project.max_runtime
    between = trial.between_seconds if math.isfinite(trial.between_seconds) else 0
    takes = math.ceil((trial.max_episodes * trial.episode_seconds + (trial.max_episodes - 1) * between) / 60)
    if trial.episode_seconds and takes > most:
        episodes = f"{trial.max_episodes} episodes" if trial.max_episodes > 1 else "an episode"
        message = f"the server ends then, and {episodes} of {trial.episode_seconds:g} seconds can take {takes}"
        yield Remark(("project", "maxRuntime"), f"{most} minute{'' if most == 1 else 's'}: {message}")


def _one_for_all(trial: TrialSection) -> Iterator[Remark]:
    """A remark on each control with which one participant ends something for all."""
    for control, does in (("stop", "ends the game"), ("reset", "ends the episode")):
        if getattr(trial.ui, control):
            yield Remark(("trial", "ui", control), f"one participant who presses it {does} for all")
