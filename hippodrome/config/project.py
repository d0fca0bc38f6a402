"""A project folder, read: its config.yml and its step files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hippodrome.config.consistency import check
from hippodrome.config.diagnostics import ConfigErrors, Diagnostic, Mistake, in_order, where_of
from hippodrome.config.models import STEPS, AwsSetup, Events, Project, Ssl
from hippodrome.config.step_files import StepFileError, open_folder
from hippodrome.config.step_order import ordered, resolve_events, step_name, visited
from hippodrome.config.validation import Checked
from hippodrome.model.step_types import StepType, type_of
from protocol.trial import MISSPELT, RIGHT, Trial

if TYPE_CHECKING:
    from hippodrome.config.yaml_file import ParsedFile

NAMES = ("config.yml", "config.yaml")


@dataclass(frozen=True, slots=True)
class StepFiles:
    """One step: its key ("1" … or "finalStep"), its page (a file name without .html, or "game"), and its files.

    `variants` is 0 for one page for everybody, else the number of files `{page}-0.html`, `{page}-1.html` …
    """

    key: str
    page: str
    variants: int = 0
    files: tuple[Path, ...] = ()

    @property
    def type(self) -> StepType:
        return type_of(self.page)


@dataclass(frozen=True, slots=True)
class Config:
    """A project that is free of mistakes.

    `steps` are in order, the last one is where the study ends; `events` are resolved: keys of steps, or None.
    """

    project: Project
    trial: Trial
    steps: tuple[StepFiles, ...]
    events: Events

    @classmethod
    def of(cls, checked: Checked, steps: list[StepFiles]) -> Config:
        """What was checked and found free of mistakes."""
        project = checked.root.project
        events = resolve_events(project.events, [step.key for step in steps], project.steps)
        return cls(project, checked.trial, tuple(steps), events)

    def registration(self) -> dict[str, Any]:
        """The project for everybody else: a JSON-able dict in camelCase with every default filled in."""
        data = self.project.model_dump(mode="json", by_alias=True)
        return data | {
            "name": self.project.name or self.project.id,
            "awsSetup": _given(self.project.aws_setup, "cpu", "memory"),
            "ssl": _given(self.project.ssl, "sslBucket", "fullchain", "privkey"),
            "events": self.events.model_dump(by_alias=True),
            "steps": [{"key": step.key, "page": step.page, "variants": step.variants} for step in self.steps],
            "trial": self.trial.document(),
        }

    @property
    def game_steps(self) -> tuple[StepFiles, ...]:
        """The steps that take place on the participant's server."""
        return tuple(step for step in self.steps if step.type.on_server)

    def summary(self) -> str:
        """What the project is, in a line: "6 steps, step 4 is the game (CartPole-v1), …"."""
        parts = ["1 step" if len(self.steps) == 1 else f"{len(self.steps)} steps"]
        parts += [f"{step_name(step.key)} is the game ({self.trial.game})" for step in self.game_steps]
        parts += [f"{step.page} in {step.variants} groups" for step in self.steps if step.variants]
        start, stop = self.events.start_server_step, self.events.stop_server_step
        if start and stop:
            limit = f"at most {self.project.max_runtime} minutes"
            parts.append(f"a server from {step_name(start)} to {step_name(stop)}, {limit}")
        if self.project.warm_servers:
            parts.append(f"{self.project.warm_servers} kept warm")
        if not self.project.live:
            parts.append("not live")
        return ", ".join(parts)


def _given(section: AwsSetup | Ssl, *needed: str) -> dict[str, Any] | None:
    """The section if all of these keys are given, otherwise None."""
    data = section.model_dump(by_alias=True)
    if any(data[key] is None for key in needed):
        return None
    return {key: int(v) if isinstance(v, float) and v.is_integer() else v for key, v in data.items()}


def read_project(folder: Path) -> Config:
    """The project in `folder`: its config.yml (or config.yaml) and its step files, in `steps` or `StepFiles`.

    Raises ConfigErrors with every mistake found.
    """
    folder = Path(folder)
    file = config_file(folder)
    parsed = _parse(file)
    checked = check(parsed.values, [mistake.path for mistake in parsed.mistakes])
    steps, missing_files = _step_files(folder, checked)
    if ("trial", MISSPELT) in parsed.lines:
        parsed.lines.setdefault(("trial", RIGHT), parsed.lines["trial", MISSPELT])
    mistakes = [*checked.mistakes, *missing_files, *parsed.mistakes]
    if mistakes:
        raise ConfigErrors(
            in_order(
                Diagnostic(file.name, m.line or parsed.line(m.path), where_of(m.path), m.message) for m in mistakes
            )
        )
    return Config.of(checked, steps)


def config_file(folder: Path) -> Path:
    """The one file that holds the configuration. Raises ConfigErrors."""
    try:
        found = [folder / name for name in NAMES if (folder / name).is_file()]
        there, is_folder = folder.exists(), folder.is_dir()
    except (OSError, ValueError):
        found, there, is_folder = [], True, True
    if not is_folder:
        message = "this is a file; name the folder it is in" if there else "there is no such folder"
        raise ConfigErrors([Diagnostic(str(folder), None, "", message)])
    if len(found) > 1:
        raise ConfigErrors([Diagnostic(NAMES[0], None, "", f"there is a {NAMES[1]} too; keep only one of them")])
    if not found:
        raise ConfigErrors([Diagnostic(NAMES[0], None, "", f"there is no such file in {folder}")])
    return found[0]


def _parse(file: Path) -> ParsedFile:
    from hippodrome.config import yaml_file  # noqa: PLC0415 - a function that only parses registrations needs no YAML

    try:
        with file.open("rb") as stream:
            return yaml_file.parse_yaml(stream.read(yaml_file.LIMIT_BYTES + 1))
    except yaml_file.UnreadableConfig as error:
        raise ConfigErrors([Diagnostic(file.name, error.line, "", str(error))]) from None
    except OSError as error:
        message = f"the file cannot be read: {error.strerror or 'unknown reason'}"
        raise ConfigErrors([Diagnostic(file.name, None, "", message)]) from None


def _step_files(folder: Path, checked: Checked) -> tuple[list[StepFiles], list[Mistake]]:
    """The steps with their files, and what is wrong with files."""
    pages = checked.root.project.steps
    steps: list[StepFiles] = []
    mistakes: list[Mistake] = []
    try:
        pages_folder = open_folder(folder)
    except StepFileError as error:
        needed = any(type_of(page).has_files for page in pages.values())
        return [], [Mistake(STEPS, str(error))] if needed else []
    for key in visited(ordered(pages), pages):
        page = pages[key]
        try:
            variants, files = pages_folder.find(page) if type_of(page).has_files else (0, ())
            steps.append(StepFiles(key, page, variants, files))
        except StepFileError as error:
            mistakes.append(Mistake((*STEPS, key), str(error)))
    return steps, mistakes
