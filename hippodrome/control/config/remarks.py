"""Makes remarks on a configuration that has no mistake, but may cost or do what its researcher does not want."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

from hippodrome.control.config import sessions, texts
from hippodrome.control.config.config import Config
from hippodrome.control.config.diagnostics import Diagnostic, Remark
from hippodrome.control.config.folder import ConfigSource, read_source
from hippodrome.control.config.hippo import SSL_NO_EFFECT
from hippodrome.control.config.project_keys import STEPS, SslKeys
from hippodrome.protocol import keyboard
from hippodrome.protocol.values import KeyPath, printable

START: KeyPath = ("project", "events", "startServerStep")

IDLE = frozenset({"noop", "no-op", "no_op", "nothing", "none", "idle", "stay", "wait", "still", "stop", "pass"})
"""Names of an action that does nothing."""

UI: KeyPath = ("trial", "ui")
KEYS: KeyPath = ("trial", "keys")
ARROWS = ("left", "right", "up", "down")
PARTS = frozenset({*ARROWS, "fire"})
"""Keys that are combined with others: "up" and "right" are the action "upright" (`trial/core/controls.py`)."""

EACH_LINK = "every opened link starts a server, also for people who look and leave"


def starts_at_link(config: Config) -> bool:
    """Return whether a participant's first visit starts a server, before any answer."""
    return bool(config.steps) and config.events.start_server_step == config.steps[0].key


def without_a_key(config: Config) -> Remark | None:
    """Return a remark if the action that the game takes without a key is not known to do nothing.

    Without a key the trial takes `idleAction`, or the action `noop`, or the first action
    (`hippodrome/trial/core/players.py`). With `pace: turns` it takes none.
    """
    names = [name.strip().lower() for name in config.trial.action_space]
    if config.trial.idle_action is not None or config.trial.pace == "turns" or not names or not config.game_steps:
        return None
    taken = "noop" if "noop" in names else names[0]
    if taken in IDLE:
        return None
    idle = next((name for name in names if name in IDLE), None)
    advice = (
        f"write idleAction: {idle}, and that is taken instead"
        if idle is not None
        else "if one of the actions does nothing, name it as idleAction; if none does, write pace: turns, or see "
        "docs/agent.md#no-key"
    )
    return Remark(
        ("trial", "actionSpace"),
        f'while no key is pressed, the game takes "{taken}", {config.trial.starting_frame_rate} times a second; '
        f"{advice}",
    )


def arrows_without_an_action(config: Config, actions: Sequence[str]) -> Iterator[Remark]:
    """Yield a remark on each arrow of `ui` that does nothing, because it is in the name of none of these actions."""
    names = [name.strip().lower() for name in actions]
    if not names or not config.game_steps or config.trial.keys:
        return
    keys = "|".join(re.escape(key) for key in sorted({*PARTS, *names}))
    for arrow in ARROWS:
        others = [name for name in names if re.fullmatch(f"(?:{keys})*{arrow}(?:{keys})*", name)]
        if getattr(config.trial.ui, arrow) and not others:
            yield Remark((*UI, arrow), f"the arrow does nothing: no action is called {arrow}")


def arrows_of_unnamed_actions(config: Config, count: int) -> Iterator[Remark]:
    """Yield a remark on the arrows of `ui` if the environment has `count` actions without names."""
    arrows = [arrow for arrow in ARROWS if getattr(config.trial.ui, arrow)]
    if not arrows or not config.game_steps or config.trial.keys:
        return
    *first, last = arrows
    shown = f"the arrows {', '.join(first)} and {last} are" if first else f"the arrow {last} is"
    example = ", ".join([*arrows[:count], *(["…"] if count > len(arrows) else [])])
    yield Remark(
        UI,
        f"{shown} not shown: the environment has {count} actions without names; name them all, in their order: "
        f"actionSpace: [{example}]",
    )


def combined_after_single(config: Config) -> Iterator[Remark]:
    """With `input: single`, yield a remark on each combination of keys that participants cannot press.

    One key of such a combination is an action by itself, which is taken before the other keys are down.
    """
    if config.trial.input != "single":
        return
    for path, keys in config.trial.key_maps():
        for combined in keys:
            parts = keyboard.parts(combined)
            alone = [part for part in parts if len(parts) > 1 and part in keys]
            if alone:
                first = keyboard.shown(alone[0])
                message = f'with input: single, {first} does "{keys[alone[0]]}" before the other key is down'
                yield Remark((*KEYS, *path, combined), message)


def several_humans(config: Config) -> Iterator[Remark]:
    """Yield a remark if several players are human although each participant plays alone."""
    if config.project.has_sessions:
        return
    for path, names in config.trial.humans():
        if len(names) > 1:
            shown = printable(", ".join(names), 100)
            message = f"{len(names)} players are human ({shown}), and a game has one participant, who plays the first"
            advice = f"write players: {len(names)} under project, or let the others be played by a policy"
            yield Remark((*sessions.WHO_PLAYS, *path), f"{message}; {advice}")


def keys_without_an_action(config: Config, actions: Sequence[str]) -> Iterator[Remark]:
    """Yield a remark on each key whose action is not among these actions, which are the environment's own."""
    if config.trial.keys_differ:
        return  # players may have different actions
    names = [name.strip().lower() for name in actions]
    for combined, action in config.trial.keys.items():
        if action not in names:
            names_shown = printable(", ".join(names), 100)
            yield Remark(
                (*KEYS, combined), f"the key does nothing: no action is called {action}; there are {names_shown}"
            )


def _names_a_certificate(config: Config) -> bool:
    """Whether a study that may run on AWS has the section `ssl`."""
    project = config.project
    return not project.keeps_off_aws and project.ssl != SslKeys()


def without_observations(source: ConfigSource, config: Config) -> Iterator[Remark]:
    """Yield a remark if a project of HIPPO's layout has no `recordObservations`: HIPPO saved observations."""
    names = source.names(("trial", "recordObservations"))
    if source.layout.of_hippo and config.game_steps and config.trial.s3upload and not names:
        message = "recordObservations is not given: recordings hold no observations, which HIPPO Gym saved"
        yield Remark(("trial",), f"{message}; write recordObservations: true to have them, or false")


def keys_of_sessions(source: ConfigSource, config: Config) -> Iterator[Remark]:
    """Yield a remark on each key for games of several participants if each participant plays alone."""
    if not config.project.has_sessions:
        message = sessions.no_effect(config.trial)
        yield from (Remark(path, message) for path in sessions.OF_SESSIONS if source.names(path))


def remarks(config: Config) -> Iterator[Remark]:
    """Yield the remarks that need only the values of the configuration."""
    if _names_a_certificate(config):
        yield Remark(("project", "ssl"), SSL_NO_EFFECT)
    if config.project.plain_clients:
        links = "; signedLinks does not protect the game then" if config.project.signed_links else ""
        message = "whoever knows a participant's id can play in that participant's place"
        yield Remark(("project", "plainClients"), f"{message}{links}; see docs/security.md#identity")
    yield from combined_after_single(config)
    yield from several_humans(config)
    yield from sessions.remarks(config)
    idle = without_a_key(config)
    if idle is not None:
        yield idle
    first, *_ = config.steps
    second = config.steps[1] if len(config.steps) > 1 else first
    if config.events.start_server_step is not None and not config.game_steps:
        message = "a server starts, and no step uses it: none is game"
        yield Remark(START, f"{message}; call the step of the game that, or leave startServerStep out")
    elif starts_at_link(config):
        if first.type.on_server:
            advice = "a page before it, such as a consent, keeps those out who only look"
            yield Remark((*STEPS, first.key), f"the game is the first step, so {EACH_LINK}; {advice}")
        else:
            yield Remark(START, f"{EACH_LINK}; with {second.key} only those get one who answered the first page")
    elif second.type.on_server and config.project.use_aws and not config.project.warm_servers:
        why = "its server starts only when a participant reaches it, who then waits for a minute or more"
        yield Remark((*STEPS, second.key), f"{why}; put a page before it, or see warmServers and startServerStep")


def remarks_on(folder: Path, config: Config) -> list[Diagnostic]:
    """Return all remarks on the project in `folder`, with the lines of its config.yml."""
    source = read_source(folder)
    arrows = [
        remark for remark in arrows_without_an_action(config, config.trial.action_space) if source.names(remark.path)
    ]  # a file without `ui` gets no remark, although all arrows are shown
    own = [*texts.shown_as_they_are(config), *texts.left_in_english(config)]
    all_remarks = [
        *remarks(config),
        *own,
        *arrows,
        *without_observations(source, config),
        *keys_of_sessions(source, config),
    ]
    return [*config.remarks, *(source.diagnostic(path, message, remark=True) for path, message in all_remarks)]
