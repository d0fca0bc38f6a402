"""A project folder, read: its config.yml and its step files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hippodrome.config import hippo_pages
from hippodrome.config.consistency import check
from hippodrome.config.diagnostics import ConfigErrors, Diagnostic, Keys, Mistake, in_order, where_of
from hippodrome.config.hippo import CLOSING_PAGE, Adapted, adapt
from hippodrome.config.layout import Layout, find
from hippodrome.config.models import STEPS, AwsSetup, Events, Project, Ssl
from hippodrome.config.step_files import CLOSING, StepFileError, open_folder
from hippodrome.config.step_order import ordered, resolve_events, step_name, visited
from hippodrome.config.validation import Checked
from hippodrome.model.step_types import StepType, type_of
from protocol.trial import MISSPELT, RIGHT, Trial

if TYPE_CHECKING:
    from hippodrome.config.yaml_file import ParsedFile


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

    `steps` are in order, the last one is where the study ends; `events` are resolved: keys of steps, or None. `remarks`
    say what was turned from HIPPO's form into ours.
    """

    project: Project
    trial: Trial
    steps: tuple[StepFiles, ...]
    events: Events
    remarks: tuple[Diagnostic, ...] = ()

    @classmethod
    def of(cls, checked: Checked, steps: list[StepFiles], remarks: Iterable[Diagnostic] = ()) -> Config:
        """What was checked and found free of mistakes."""
        project = checked.root.project
        events = resolve_events(project.events, [step.key for step in steps], project.steps)
        return cls(project, checked.trial, tuple(steps), events, tuple(remarks))

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

    @property
    def own_pages(self) -> list[Path]:
        """The files of pages that Hippodrome brings, which lie in no folder of the project."""
        return [file for step in self.steps for file in step.files if file == CLOSING]

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


@dataclass(frozen=True, slots=True)
class Source:
    """A project's config.yml as it was read: its values in our form, and where each of them stands."""

    layout: Layout
    parsed: ParsedFile
    adapted: Adapted

    def diagnostic(self, path: Keys, message: str, *, line: int | None = None, remark: bool = False) -> Diagnostic:
        """What to say about the value at a path of our form: at its line (or another one) in the file."""
        origin = self.adapted.origin(path)
        return self._diagnostic(origin, message, line, remark)

    def remarks(self) -> list[Diagnostic]:
        """What was turned from HIPPO's form into ours."""
        return in_order(self._diagnostic(path, message, None, True) for path, message in self.adapted.remarks)

    def names(self, path: Keys) -> bool:
        """Whether the file itself has this path of our form."""
        return self.adapted.origin(path) in self.parsed.lines

    def _diagnostic(self, origin: Keys, message: str, line: int | None, remark: bool) -> Diagnostic:
        if origin == ("trial", RIGHT) and origin not in self.parsed.lines and ("trial", MISSPELT) in self.parsed.lines:
            line = line or self.parsed.lines["trial", MISSPELT]
        file = self.layout.label(self.layout.config)
        return Diagnostic(file, line or self.parsed.line(origin), where_of(origin), message, remark)


def read_source(folder: Path) -> Source:
    """The config.yml of the project in `folder`, not checked yet. Raises ConfigErrors if it cannot be read."""
    layout = find(folder)
    parsed = _parse(layout)
    return Source(layout, parsed, adapt(parsed.values, Path(folder).resolve().name))


def read_project(folder: Path) -> Config:
    """The project in `folder`: its config.yml (or config.yaml) and its step files; `layout` says where they may lie.

    Raises ConfigErrors with every mistake found.
    """
    source = read_source(folder)
    checked = check(source.adapted.values, [mistake.path for mistake in source.parsed.mistakes])
    steps, missing_files = _step_files(folder, checked)
    mistakes = [source.diagnostic(m.path, m.message, line=m.line) for m in (*checked.mistakes, *missing_files)]
    mistakes += [source.diagnostic(m.path, m.message, line=m.line) for m in source.parsed.mistakes]
    agent = list(source.layout.problems()) if any(step.type.on_server for step in steps) else []
    mistakes += [problem for problem in agent if not problem.remark]
    if mistakes:
        raise ConfigErrors(in_order(mistakes))
    loaded = _loaded_from(source, steps)
    if loaded:
        project = checked.root.project.model_copy(update={"allowed_hosts": loaded})
        checked.root = checked.root.model_copy(update={"project": project})
        message = f"allowedHosts is not given: the pages may load from {', '.join(loaded)}, as with HIPPO Gym"
        agent.append(source.diagnostic(("project",), message, remark=True))
    return Config.of(checked, steps, in_order([*source.remarks(), *agent]))


def _loaded_from(source: Source, steps: list[StepFiles]) -> tuple[str, ...]:
    """From which sites a project of HIPPO Gym, which has no `allowedHosts`, loads something."""
    if not source.layout.of_hippo or source.names(("project", "allowedHosts")):
        return ()
    return hippo_pages.hosts(file for step in steps for file in step.files)


def _parse(layout: Layout) -> ParsedFile:
    from hippodrome.config import yaml_file  # noqa: PLC0415 - a function that only parses registrations needs no YAML

    file, label = layout.config, layout.label(layout.config)
    try:
        with file.open("rb") as stream:
            return yaml_file.parse_yaml(stream.read(yaml_file.LIMIT_BYTES + 1))
    except yaml_file.UnreadableConfig as error:
        raise ConfigErrors([Diagnostic(label, error.line, "", str(error))]) from None
    except OSError as error:
        message = f"the file cannot be read: {error.strerror or 'unknown reason'}"
        raise ConfigErrors([Diagnostic(label, None, "", message)]) from None


def _step_files(folder: Path, checked: Checked) -> tuple[list[StepFiles], list[Mistake]]:
    """The steps with their files, and what is wrong with files."""
    pages = checked.root.project.steps
    steps: list[StepFiles] = []
    mistakes: list[Mistake] = []
    own = {page for page in pages.values() if type_of(page).has_files and page != CLOSING_PAGE}
    try:
        pages_folder = open_folder(folder) if own else None
    except StepFileError as error:
        return [], [Mistake(STEPS, str(error))]
    for key in visited(ordered(pages), pages):
        page = pages[key]
        try:
            variants, files = pages_folder.find(page) if pages_folder and page in own else (0, ())
            steps.append(StepFiles(key, page, variants, (CLOSING,) if page == CLOSING_PAGE else files))
        except StepFileError as error:
            mistakes.append(Mistake((*STEPS, key), str(error)))
    return steps, mistakes
