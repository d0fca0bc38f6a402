"""Reads and checks a project folder: its config.yml and its step files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hippodrome.control.config import hippo_pages, sessions
from hippodrome.control.config.config import Config, StepFiles
from hippodrome.control.config.consistency import check
from hippodrome.control.config.diagnostics import ConfigErrors, Diagnostic, Mistake, in_order
from hippodrome.control.config.each_value import Checked
from hippodrome.control.config.hippo import CLOSING_PAGE, Adapted, adapt
from hippodrome.control.config.layout import AGENT, Layout, find
from hippodrome.control.config.project_keys import STEPS
from hippodrome.control.config.step_files import CLOSING, StepFileError, StepFolder, open_folder
from hippodrome.control.model.design import Step, cells, fill
from hippodrome.control.model.project import number_of_groups
from hippodrome.control.model.step_order import ordered, visited
from hippodrome.control.model.step_types import type_of
from hippodrome.protocol import players
from hippodrome.protocol.trial import RATE_CHANGE, RATE_CHANGE_MISSPELT
from hippodrome.protocol.trial_llm import MAX_PROMPT_FILE, prompt_file
from hippodrome.protocol.values import KeyPath, is_blank, path_text

if TYPE_CHECKING:
    from hippodrome.control.config.yaml_file import ParsedFile


@dataclass(frozen=True, slots=True)
class ConfigSource:
    """A project's config.yml as read: its values in Hippodrome's form, and the line of each."""

    layout: Layout
    parsed: ParsedFile
    adapted: Adapted

    def diagnostic(self, path: KeyPath, message: str, *, line: int | None = None, remark: bool = False) -> Diagnostic:
        """Return a mistake or remark on the value at this path of Hippodrome's form.

        Without `line`, it names the line of the value.
        """
        origin = self.adapted.origin(path)
        return self._diagnostic(origin, message, line, remark)

    def remarks(self) -> list[Diagnostic]:
        """Return a remark for each value that was translated from HIPPO's form."""
        return in_order(self._diagnostic(path, message, None, True) for path, message in self.adapted.remarks)

    def names(self, path: KeyPath) -> bool:
        """Return whether the file gives a value for this path of Hippodrome's form."""
        return self.adapted.origin(path) in self.parsed.lines

    def _diagnostic(self, origin: KeyPath, message: str, line: int | None, remark: bool) -> Diagnostic:
        if (
            origin == ("trial", RATE_CHANGE)
            and origin not in self.parsed.lines
            and ("trial", RATE_CHANGE_MISSPELT) in self.parsed.lines
        ):
            line = line or self.parsed.lines["trial", RATE_CHANGE_MISSPELT]
        file = self.layout.label(self.layout.config)
        return Diagnostic(file, line or self.parsed.line(origin), path_text(origin), message, remark)


def read_source(folder: Path) -> ConfigSource:
    """Read the config.yml of the project in `folder`, without checking it. Raises ConfigErrors if it cannot be read."""
    layout = find(folder)
    parsed = _parse(layout)
    return ConfigSource(layout, parsed, adapt(parsed.values, Path(folder).resolve().name))


def read_project(folder: Path) -> Config:
    """Read and check the project in `folder`: its config.yml (or config.yaml) and its step files (`layout`).

    Raises ConfigErrors with all mistakes.
    """
    source = read_source(folder)
    checked = check(source.adapted.values, [mistake.path for mistake in source.parsed.mistakes])
    steps, file_mistakes = _step_files(folder, checked)
    game_pages, page_mistakes = _game_pages(folder, checked, steps)
    file_mistakes += [*page_mistakes, *_of_end_pages(folder, checked), *_missing_policies(source.layout, checked)]
    file_mistakes += _missing_prompts(source.layout, checked)
    if checked.valid(STEPS) and not file_mistakes:
        groups = number_of_groups(page.variants for page in (*steps, *game_pages))
        file_mistakes += sessions.mistakes_of_groups(checked, groups)
    all_mistakes = (*checked.mistakes, *file_mistakes, *source.parsed.mistakes)
    mistakes = [source.diagnostic(mistake.path, mistake.message, line=mistake.line) for mistake in all_mistakes]
    agent = list(_agent_problems(source, others=bool(mistakes))) if any(step.type.on_server for step in steps) else []
    mistakes += [problem for problem in agent if not problem.remark]
    if mistakes:
        raise ConfigErrors(in_order(mistakes))
    loaded = _loaded_from(source, steps)
    if loaded:
        checked.project = replace(checked.project, allowed_hosts=loaded)
        message = f"allowedHosts is not given: the pages may load from {', '.join(loaded)}, as with HIPPO Gym"
        agent.append(source.diagnostic(("project",), message, remark=True))
    design = [source.diagnostic(path, message, remark=True) for path, message, *_ in checked.design.remarks]
    return Config.of(checked, steps, game_pages, in_order([*source.remarks(), *design, *agent]))


def _agent_problems(source: ConfigSource, *, others: bool) -> Iterator[Diagnostic]:
    """The mistakes and remarks on agent.py. A study without agent and environment is one, unless there are `others`."""
    problems = list(source.layout.problems())
    yield from problems
    if others or source.layout.agent is not None or any(not problem.remark for problem in problems):
        return
    trial = source.parsed.values.get("trial")
    if not isinstance(trial, dict) or ("game" in trial and is_blank(trial["game"])):
        message = f"is empty, and there is no {AGENT}: name an environment, or write an {AGENT}"
        yield source.diagnostic(("trial", "game"), message)


def _missing_policies(layout: Layout, checked: Checked) -> Iterator[Mistake]:
    """A mistake for each policy's file in `trial.players` and `trial.substitute` that does not exist."""
    for path, file in checked.trial.policy_files():
        if not (layout.agent_folder / file).is_file():
            hint = players.files_there(layout.agent_folder)
            yield Mistake(("trial", *path), f"there is no file {file} beside agent.py{hint}")


def _missing_prompts(layout: Layout, checked: Checked) -> Iterator[Mistake]:
    """A mistake for each file that `trial.llm.system` names, in any game, and that cannot be a prompt."""
    first = {} if checked.trial.llm is None else {"llm": {"system": checked.trial.llm.system}}
    own = [section.trial for step in checked.design.steps for section in step.sections]
    prompts = [(section.get("llm") or {}).get("system") for section in (first, *own)]
    for file in dict.fromkeys(file for prompt in prompts if prompt and (file := prompt_file(prompt))):
        problem = None
        try:
            text = (layout.agent_folder / file).read_bytes()
            if len(text) > MAX_PROMPT_FILE or not text.decode("utf-8").strip():
                problem = f"{file} must have some text, and at most {MAX_PROMPT_FILE // 1024} kB"
        except OSError:
            problem = f"there is no file {file} beside agent.py"
        except UnicodeDecodeError:
            problem = f"{file} is not text in UTF-8; save it as such"
        if problem:
            yield Mistake(("trial", "llm", "system"), problem)


def _loaded_from(source: ConfigSource, steps: list[StepFiles]) -> tuple[str, ...]:
    """The sites from which the pages of a HIPPO Gym project without `allowedHosts` load something."""
    if not source.layout.of_hippo or source.names(("project", "allowedHosts")):
        return ()
    return hippo_pages.hosts(file for step in steps for file in step.files)


def _parse(layout: Layout) -> ParsedFile:
    from hippodrome.control.config import yaml_file  # noqa: PLC0415 - a function that only parses registrations needs no YAML

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
    """The steps with their files, and the mistakes in files."""
    pages = checked.project.steps
    steps: list[StepFiles] = []
    mistakes: list[Mistake] = []
    own = {page for page in pages.values() if type_of(page).has_files and page != CLOSING_PAGE}
    try:
        pages_folder = open_folder(folder) if own else None
    except StepFileError as error:
        return [], [Mistake(STEPS, str(error))]
    steps_by_key = {step.key: step for step in checked.design.steps}
    for key in visited(ordered(pages), pages):
        page = pages[key]
        try:
            variants, files = (
                _files_of(pages_folder, page, checked, steps_by_key.get(key))
                if pages_folder and page in own
                else (0, ())
            )
            own_files = (CLOSING,) if page == CLOSING_PAGE else files
            steps.append(StepFiles(key, page, variants, own_files, steps_by_key.get(key)))
        except StepFileError as error:
            mistakes.append(Mistake(checked.design.paths.get(key, (*STEPS, key)), str(error)))
    return steps, mistakes


def _files_of(folder: StepFolder, page: str, checked: Checked, step: Step | None) -> tuple[int, tuple[Path, ...]]:
    """The number of versions of a page, and its files; of a page with `{factor}` the file of each level.

    Raises StepFileError.
    """
    if "{" not in page or step is None:
        return folder.find(page)
    design = checked.design
    within = design.blocks[step.block].factors if step.block is not None else ()
    factors = [factor for factor in (*design.conditions, *within) if f"{{{factor.name}}}" in page]
    if not factors:
        raise StepFileError(f"there is no factor of the name in {page}")
    return 0, tuple(file for levels in cells(factors) for file in folder.find(fill(page, levels))[1])


def _of_end_pages(folder: Path, checked: Checked) -> Iterator[Mistake]:
    """The mistakes in the files of ends. Whoever comes to an end without its file would get an error page."""
    for end in checked.design.ends:
        if not end.page:
            continue
        path = ("project", "ends", end.name, "page")
        try:
            variants, _ = open_folder(folder).find(end.page)
        except StepFileError as error:
            yield Mistake(path, str(error))
        else:
            if variants:
                yield Mistake(path, f"the page of an end is one for all groups; write {end.page}.html alone")


def _game_pages(folder: Path, checked: Checked, steps: list[StepFiles]) -> tuple[list[StepFiles], list[Mistake]]:
    """The pages that the game page shows, with their files, and the mistakes in files."""
    step_files: list[StepFiles] = []
    mistakes: list[Mistake] = []
    for key, page in checked.trial.pages.items() if any(step.type.on_server for step in steps) else ():
        try:
            step_files.append(StepFiles(key, page, *open_folder(folder).find(page)))
        except StepFileError as error:
            mistakes.append(Mistake(("trial", key), str(error)))
    return step_files, mistakes
