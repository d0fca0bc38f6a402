"""A project that passed every check: the values of its config.yml, and its registration."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from hippodrome.control.config.design import Design
from hippodrome.control.config.diagnostics import Diagnostic
from hippodrome.control.config.each_value import Checked
from hippodrome.control.config.project_keys import AwsSetupKeys, EventsKeys, ProjectKeys
from hippodrome.control.config.step_files import CLOSING
from hippodrome.control.config.step_order import resolve_events, step_name
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import number_of_groups
from hippodrome.control.model.step_types import StepType, type_of
from hippodrome.protocol.section_keys import document
from hippodrome.protocol.trial import TrialSection


@dataclass(frozen=True, slots=True)
class StepFiles:
    """One step: its key ("1" … or "finalStep"), its page (a file name without .html, or "game"), and its files.

    `variants` is 0 if all participants get one page, else the number of files `{page}-0.html`, `{page}-1.html` …
    """

    key: str
    page: str
    variants: int = 0
    files: tuple[Path, ...] = ()
    step: Step | None = None
    """What the study's design says of the step; None for a page that a game shows."""

    @property
    def type(self) -> StepType:
        return type_of(self.page)


@dataclass(frozen=True, slots=True)
class Config:
    """A project without mistakes.

    `steps` are in order; the study ends with the last one. `events` has keys of steps, with the defaults filled in, or
    None. `remarks` say what was translated from HIPPO's form, and what else may not be intended.
    """

    project: ProjectKeys
    trial: TrialSection
    steps: tuple[StepFiles, ...]
    events: EventsKeys
    game_pages: tuple[StepFiles, ...] = ()
    """The pages that the game page shows; the key of each is the key of `trial` that names it."""
    remarks: tuple[Diagnostic, ...] = ()
    design: Design = field(default_factory=Design)

    @classmethod
    def of(
        cls,
        checked: Checked,
        steps: list[StepFiles],
        game_pages: Iterable[StepFiles] = (),
        remarks: Iterable[Diagnostic] = (),
    ) -> Config:
        """Return the project with these checked values, which have no mistakes."""
        project, repeated = checked.project, {step.key for step in checked.design.steps if step.block is not None}
        events = resolve_events(project.events, [step.key for step in steps], project.steps, repeated)
        return cls(project, checked.trial, tuple(steps), events, tuple(game_pages), tuple(remarks), checked.design)

    def registration(self) -> dict[str, Any]:
        """Return the project's registration: JSON values by the keys of config.yml, with every default filled in."""
        data = {key: value for key, value in document(self.project).items() if key not in ("ssl", "conditions", "ends")}
        return data | {
            "name": self.project.name or self.project.id,
            "awsSetup": _sized(self.project.aws_setup),
            "events": document(self.events),
            "steps": [_registered(step) for step in self.steps],
            **_registered_design(self.design),
            "texts": self.project.own_texts,
            "gamePages": {game_page.key: game_page.variants for game_page in self.game_pages},
            "trial": self.trial.registered(),
        }

    @property
    def game_steps(self) -> tuple[StepFiles, ...]:
        """The steps that take place on the participant's server: game steps."""
        return tuple(step for step in self.steps if step.type.on_server)

    @property
    def models(self) -> list[Mapping[str, Any]]:
        """The sections `llm` of the study's games, at all levels; empty if no game has a language model."""
        own = [section.trial for step in self.design.steps for section in step.sections]
        llms = (section.get("llm") for section in (self.trial.registered(), *own))
        return [section for section in llms if section]

    @property
    def groups(self) -> int:
        """The number of groups of participants; 0 if the study has no groups."""
        return number_of_groups(page.variants for page in (*self.steps, *self.game_pages))

    @property
    def each_group(self) -> list[int | None]:
        """The number of each group of participants; [None] if the study has no groups."""
        return [*range(self.groups)] or [None]

    @property
    def own_pages(self) -> list[Path]:
        """The files of Hippodrome's own pages that the study uses. They do not lie in the project's folder."""
        return [file for step in self.steps for file in step.files if file == CLOSING]

    @property
    def end_pages(self) -> list[str]:
        """The names of the files that ends before the last step show."""
        return [f"{end.page.removesuffix('.html')}.html" for end in self.design.ends if end.page]

    def summary(self) -> str:
        """Return the project in one line: "6 steps, step 4 is the game (CartPole-v1), …"."""
        parts = ["1 step" if len(self.steps) == 1 else f"{len(self.steps)} steps"]
        together = f" for {self.project.players} participants together" if self.project.has_sessions else ""
        games = " and ".join(step_name(step.key) for step in self.game_steps)
        if games:
            verb = "is the game" if len(self.game_steps) == 1 else "are games"
            parts.append(f"{games} {verb} ({self.trial.game}){together}")
        parts += [f"{step.page} in {step.variants} groups" for step in (*self.steps, *self.game_pages) if step.variants]
        start, stop = self.events.start_server_step, self.events.stop_server_step
        if start and stop:
            limit = f"at most {self.project.max_runtime} minute{'' if self.project.max_runtime == 1 else 's'}"
            parts.append(f"a server from {step_name(start)} to {step_name(stop)}, {limit}")
        if self.project.warm_servers:
            parts.append(f"{self.project.warm_servers} kept warm")
        if not self.project.live:
            parts.append("not live")
        return ", ".join(parts)


def _registered(step: StepFiles) -> dict[str, Any]:
    """A step as a registration stores it: what its design says, with its page and the number of its versions."""
    settings = msgspec.to_builtins(step.step) if step.step else {}
    return {**settings, "key": step.key, "page": step.page, "variants": step.variants}


def _registered_design(design: Design) -> dict[str, Any]:
    """The factors, blocks and ends of a study as a registration stores them; empty for a study without any."""
    design_data = {name: msgspec.to_builtins(getattr(design, name)) for name in ("conditions", "blocks", "ends")}
    return {name: value for name, value in design_data.items() if value}


def _sized(setup: AwsSetupKeys) -> dict[str, Any] | None:
    """The section if it has the servers' size, otherwise None."""
    data = document(setup)
    if setup.cpu is None or setup.memory is None:
        return None
    return {key: int(v) if isinstance(v, float) and v.is_integer() else v for key, v in data.items()}
