"""Reads the design of a study: `project.steps` as a list, `project.conditions` and `project.ends`.

It returns the records of `control/model/design.py`, and a mistake with its path for whatever cannot be meant. The
sections of games are checked as `trial` is, once for each combination of the levels that they name.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import msgspec

from hippodrome.control.config.diagnostics import Mistake
from hippodrome.control.model import design, rules
from hippodrome.control.model.design import COMPLETE, FAILED, Block, End, Factor, Section, Step
from hippodrome.control.model.records import from_data
from hippodrome.protocol import values
from hippodrome.protocol.section_keys import names
from hippodrome.protocol.similar import did_you_mean
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.trial_check import check as check_trial
from hippodrome.protocol.values import KeyPath, Plain, is_blank, number_in, show, step_file

PROJECT: KeyPath = ("project",)
STEPS: KeyPath = ("project", "steps")
CONDITIONS: KeyPath = ("project", "conditions")
ENDS: KeyPath = ("project", "ends")
MAX_CELLS = 64
MAX_DEPTH = 16
"""Levels of maps and lists; deeper ones, which no valid file has, are left as they are."""
MAX_SECTIONS = 500
"""The most sections of all games, at all levels that they name."""
ONE_FOR_ALL = ("game", "actionSpace", "scene", "gym")
"""Keys of `trial` that all games of a study share."""
PAGE_KEYS = ("page", "right", "tries", "minSeconds", "maxSeconds")
BLOCK_KEYS = ("each", "order", "take", "steps")
END_KEYS = ("when", "minutes", "page", "code", "link")
RESERVED = frozenset(
    (
        *("answers", "complete", "condition", "end", "ended", "arrived", "each", "group", "order", "participant"),
        *("position", "run", "seat", "session", "steps", "unmatched", "version"),
    )
)
"""Names that tables and rules use for something else."""
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
_LEVEL = re.compile(r"[A-Za-z0-9_.]{1,32}")
_FACTOR = re.compile(r"\{([A-Za-z]\w*)\}")
_CODE = re.compile(r"[A-Za-z0-9_-]{1,64}")


@dataclass
class Design:
    """A study's design as read. `steps` have no files and no sections yet (`with_sections`).

    `own_trial` has the keys of `trial` that a game has for itself, as written, by the step's key; `paths` the place of
    each step in the file; `trial` the section `trial` as written.
    """

    steps: list[Step] = field(default_factory=list)
    conditions: tuple[Factor, ...] = ()
    blocks: tuple[Block, ...] = ()
    ends: tuple[End, ...] = ()
    mistakes: list[Mistake] = field(default_factory=list)
    remarks: list[Mistake] = field(default_factory=list)
    unknown: set[str] = field(default_factory=set)
    """Names in braces in `trial` that are no factors."""
    own_trial: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    paths: dict[str, KeyPath] = field(default_factory=dict)
    trial: Any = None
    is_named: bool = False
    """Whether the steps are a list with names."""

    @property
    def pages(self) -> dict[str, str]:
        """The page of each step, by its key."""
        return {step.key: step.page for step in self.steps}

    @property
    def first_trial(self) -> Any:
        """The section `trial` with the first level of each factor filled in."""
        factors = [*self.conditions, *(factor for block in self.blocks for factor in block.factors)]
        levels = {factor.name: next(iter(factor.levels.values())) for factor in factors if factor.levels}
        levels |= dict.fromkeys(self.unknown, "x")  # a mistake already, and not another one of the key
        return filled(self.trial, levels) if levels else self.trial


@dataclass(frozen=True)
class RegisteredDesign:
    """The design in a registration: records, with the sections of games, as `control/model/project.py` stores them."""

    steps: list[Step]
    conditions: tuple[Factor, ...] = ()
    blocks: tuple[Block, ...] = ()
    ends: tuple[End, ...] = ()


def read_registered(data: Mapping[str, Any]) -> RegisteredDesign:
    """Read the design in a registration from outside. Raises ValueError with what is wrong."""
    keys = {name: data[name] for name in ("steps", "conditions", "blocks", "ends") if name in data}
    registered = from_data(keys, RegisteredDesign)
    if any(step.block is not None and not 0 <= step.block < len(registered.blocks) for step in registered.steps):
        raise ValueError("steps: a step names a block that is not there")
    rules_ = [
        *(step.when for step in registered.steps if step.when),
        *(rule for end in registered.ends for rule in end.when),
    ]
    for rule in rules_:
        rules.mentioned(rule)
    for step in registered.steps:
        for section in step.sections:
            _, problems = check_trial(dict(section.trial))
            if wrong := [problem for problem in problems if not problem.compared]:
                raise ValueError(f"steps.{step.key}: {wrong[0].sentence}")
    names_ = [
        factor.name for factor in (*registered.conditions, *(f for block in registered.blocks for f in block.factors))
    ]
    well_named = all(map(_NAME.fullmatch, names_)) and len(set(names_)) == len(names_)
    if not well_named or len(design.cells(registered.conditions)) > MAX_CELLS:
        raise ValueError(f"conditions: the factors need different names, and at most {MAX_CELLS} cells")
    return registered


def read(project: Any, trial: Any) -> Design:
    """Read the design in the sections `project` and `trial` of a config.yml, or of a registration."""
    reader = _Reader(trial)
    if isinstance(project, dict):
        reader.read(project)
    return reader.design


def filled(value: Any, levels: Mapping[str, Any], depth: int = MAX_DEPTH) -> Any:
    """Return a value with the levels in the place of each `{factor}`. A text that is only `{factor}` is the level."""
    if isinstance(value, dict) and depth:
        return {key: filled(inner, levels, depth - 1) for key, inner in value.items()}
    if isinstance(value, list) and depth:
        return [filled(inner, levels, depth - 1) for inner in value]
    if not isinstance(value, str) or "{" not in value:
        return value
    alone = _FACTOR.fullmatch(value)
    if alone and alone[1] in levels:
        return levels[alone[1]]
    return design.fill(value, levels)


def named_factors(value: Any) -> set[str]:
    """Return the names in braces in all texts of a value."""
    return {name for _, text in _texts(value, ()) for name in _FACTOR.findall(text)}


class _Reader:
    def __init__(self, trial: Any) -> None:
        self.design = Design(trial=trial)
        self._factors: dict[str, KeyPath] = {}
        self._all_names: set[str] = set()
        self._block_now: int | None = None

    def read(self, project: dict[str, Any]) -> None:
        design_read = self.design
        conditions = project.get("conditions")
        if isinstance(conditions, dict):
            factors = [self._factor(name, levels, (*CONDITIONS, name)) for name, levels in conditions.items()]
            design_read.conditions = tuple(factor for factor in factors if factor is not None)
        elif not is_blank(conditions):
            self._wrong(CONDITIONS, "must be a map of factors, such as partner: [helpful, lazy]")
        cells = len(design.cells(design_read.conditions))
        if cells > MAX_CELLS:
            self._wrong(CONDITIONS, f"makes {cells} cells; at most {MAX_CELLS}")
        steps = project.get("steps")
        if isinstance(steps, list):
            design_read.is_named = True
            self._steps(steps)
        elif isinstance(steps, dict):
            for key, page in steps.items():
                if isinstance(page, dict):
                    name = str(page.get("page") or "name")
                    self._wrong(
                        (*STEPS, key),
                        f"settings need the list form, in which steps have names: - {name}: {{…}} instead of {key}: …",
                    )
        if not design_read.mistakes:  # otherwise a rule would ask about steps that could not be read
            self._ends(project.get("ends"))
            self._unknown_factors()
            self._checks_without_an_end()

    def _wrong(self, path: KeyPath, message: str) -> None:
        self.design.mistakes.append(Mistake(path, message))

    def _unknown_factors(self) -> None:
        """Note each name in braces in `trial` that is no factor. In a study without factors braces are plain text."""
        if not self._factors and not self.design.is_named:
            return
        for path, text in _texts(self.design.trial, ()):
            for name in set(_FACTOR.findall(text)) - self._factors.keys():
                self.design.unknown.add(name)
                near = did_you_mean(name, self._factors)
                add = "" if near else f"; add it to conditions, such as conditions: {{{name}: [a, b]}}"
                self._wrong(("trial", *path), f"there is no factor {name}{near or add}")

    def _checks_without_an_end(self) -> None:
        """Remark on a check with limited tries, if no end asks who has passed."""
        checked = {name for end in self.design.ends for rule in end.when for name in rules.steps_mentioned(rule)}
        for step in self.design.steps:
            if step.tries and step.key not in checked:
                message = (
                    f"no end asks for answers.{step.key}.passed: who fails goes on like everybody, and the column "
                    f"{step.key}.passed tells"
                )
                self.design.remarks.append(Mistake((*self.design.paths[step.key], "tries"), message))

    # Factors

    def _factor(self, name: str, levels: Any, path: KeyPath) -> Factor | None:
        """Read a factor: a list of levels, a number n for 1 … n, or a map of names and values."""
        if not _NAME.fullmatch(name) or name in RESERVED:
            self._wrong(path, f"a factor cannot be called {name}; use another word of letters, digits and underscores")
            return None
        if name in self._factors:
            self._wrong(path, f"there are two factors called {name}; rename one of them")
            return None
        self._factors[name] = path
        number = number_in(levels) if not isinstance(levels, str) else None
        if isinstance(number, int) and 2 <= number <= 1000:
            return Factor(name, {str(level): level for level in range(1, number + 1)})
        if isinstance(levels, dict):
            level_values = {key: _level(value) for key, value in levels.items()}
        elif isinstance(levels, list) and not any(
            isinstance(level, dict | list) or is_blank(level) for level in levels
        ):
            level_values = {_text(level): _level(level) for level in levels}
            if len(level_values) < len(levels):
                self._wrong(path, "names a level twice")
        else:
            self._wrong(path, f"must be a list of levels, such as [helpful, lazy], not {show(levels)}")
            return None
        if len(level_values) < 2:
            self._wrong(path, "has one level; a factor needs two or more, or leave it out")
        for level in level_values:
            if not _LEVEL.fullmatch(level):
                word = re.sub(r"[^A-Za-z0-9_.]+", "_", level).strip("_") or "word"
                self._wrong(
                    path,
                    f"a level's name has letters, digits, _ and . only; give {show(level)} a name: "
                    f'{{{word}: "{level}"}}',
                )
        return Factor(name, level_values)

    # Steps

    def _steps(self, items: list[Any]) -> None:
        self._all_names = {name for item in items for name in _names_in(item)}
        for place, item in enumerate(items):
            path: KeyPath = (*STEPS, place)
            if isinstance(item, dict) and "each" in item:
                self._block(item, path)
            else:
                self._step(item, path, None)
        if not items:
            self._wrong(STEPS, "has no steps; list the pages in order, such as - consent")
        elif self.design.steps and self.design.steps[-1].block is not None:
            self._wrong(
                (*STEPS, len(items) - 1), "the last step is the end of the study, so it cannot be repeated; add a page"
            )

    def _block(self, item: dict[str, Any], path: KeyPath) -> None:
        for key in item.keys() - {*BLOCK_KEYS}:
            self._wrong(
                (*path, key),
                f"unknown key of a block{did_you_mean(str(key), BLOCK_KEYS)}; it has {', '.join(BLOCK_KEYS)}",
            )
        factor_levels, steps = item.get("each"), item.get("steps")
        if not isinstance(factor_levels, dict) or not factor_levels:
            self._wrong((*path, "each"), "must be a map of factors, such as {look: [plain, face, voice]}")
            return
        factors = [self._factor(name, levels, (*path, "each", name)) for name, levels in factor_levels.items()]
        order = _text(item.get("order", design.LATIN))
        if order not in design.ORDERS:
            self._wrong((*path, "order"), f"must be {' or '.join(design.ORDERS)}, not {show(item.get('order'))}")
            order = design.LATIN
        take = self._number(item.get("take"), (*path, "take"), 1, 1000, whole=True)
        block = Block(
            tuple(factor for factor in factors if factor is not None), order, None if take is None else int(take)
        )
        if len(block.runs) > 1000 or (order == design.LATIN and len(block.runs) > 50):
            most = 50 if order == design.LATIN else 1000
            self._wrong((*path, "each"), f"makes {len(block.runs)} runs; with order: {order} at most {most}")
        self._block_now = number = len(self.design.blocks)
        self.design.blocks = (*self.design.blocks, block)
        if not isinstance(steps, list) or not steps:
            self._wrong((*path, "steps"), "must be a list of the steps that are repeated, such as [game, rate]")
            return
        for place, inner in enumerate(steps):
            if isinstance(inner, dict) and "each" in inner:
                self._wrong(
                    (*path, "steps", place), "is a block in a block; write both factors in one: each: {a: […], b: […]}"
                )
                continue
            self._step(inner, (*path, "steps", place), number)
        self._block_now = None

    def _step(self, item: Any, path: KeyPath, block: int | None) -> None:
        """Read a step: a name, or a name with its settings."""
        if isinstance(item, dict) and len(item) != 1:
            first, rest = next(iter(item), "name"), ", ".join(map(str, item))
            self._wrong(
                path,
                "a step is a name, or one name with its settings in braces or indented below it; "
                f"{rest} are {len(item)} names. Indent the settings of {first} by two more spaces",
            )
            return
        if isinstance(item, list) or is_blank(item):
            self._wrong(path, f"must be the name of a step, not {show(item)}")
            return
        page, settings = next(iter(item.items())) if isinstance(item, dict) else (_text(item), {})
        name = str(page).removesuffix(".html")
        here = (*path, page) if isinstance(item, dict) else path
        settings = {} if is_blank(settings) else settings
        if not isinstance(settings, dict):
            self._wrong(here, f"must be a map of settings, such as {name}: {{tries: 2}}, or {name} alone")
            return
        if not _NAME.fullmatch(name) or (name in RESERVED and name != "end"):
            better = re.sub(r"\W+", "_", name).strip("_") or "page"
            self._wrong(here, f"a step's name has letters, digits and _; write - {better}: {{page: {name}}}")
            return
        if name in self.design.paths:
            self._wrong(
                here, f"there are two steps called {name}; name one of them otherwise: - {name}2: {{page: {name}}}"
            )
            return
        self.design.paths[name] = here
        own = {key: value for key, value in settings.items() if key != "when" and not is_blank(value)}
        is_game = name == "game" or bool(own.keys() & (names(TrialSection) - {*PAGE_KEYS}))
        step = Step(
            name, "game" if is_game else name, when=self._rule(settings.get("when"), (*here, "when")), block=block
        )
        self.design.steps.append(self._game(step, own, here) if is_game else self._page(step, own, here))

    def _game(self, step: Step, own: dict[str, Any], path: KeyPath) -> Step:
        trial_keys = names(TrialSection)
        for key in own:
            if key in PAGE_KEYS:
                why = next(iter(own.keys() & trial_keys), "")
                self._wrong(
                    (*path, key), f"is a setting of pages, and {step.key} is a game{f' (it has {why})' if why else ''}"
                )
            elif key in ONE_FOR_ALL:
                self._wrong(
                    (*path, key),
                    "is one for all games of a study: write it under trial, and say under options what differs",
                )
            elif key not in trial_keys:
                self._wrong(
                    (*path, key),
                    f"unknown key of a game{did_you_mean(key, trial_keys)}; a game takes the keys of trial",
                )
        self.design.own_trial[step.key] = {key: value for key, value in own.items() if key in trial_keys}
        return step

    def _page(self, step: Step, own: dict[str, Any], path: KeyPath) -> Step:
        for key in own.keys() - {*PAGE_KEYS}:
            self._wrong(
                (*path, key),
                f"unknown setting of a page{did_you_mean(key, [*PAGE_KEYS, *names(TrialSection)])}; "
                f"a page has {', '.join((*PAGE_KEYS, 'when'))}",
            )
        page = step.page
        if "page" in own:
            try:
                page = _page_name(own["page"])
            except ValueError as error:
                self._wrong((*path, "page"), str(error))
        right = own.get("right", {})
        if not isinstance(right, dict) or any(isinstance(value, dict | list) for value in right.values()):
            self._wrong((*path, "right"), "must be a map of fields and their right answers, such as {soups: 3}")
            right = {}
        tries = self._number(own.get("tries"), (*path, "tries"), 1, 100, whole=True)
        if tries is not None and not right:
            self._wrong((*path, "tries"), "needs right: the fields and their right answers, such as right: {soups: 3}")
        least = self._number(own.get("minSeconds"), (*path, "minSeconds"), 0, 30 * 86_400)
        most = self._number(own.get("maxSeconds"), (*path, "maxSeconds"), 1, 30 * 86_400)
        return msgspec.structs.replace(
            step,
            page=page,
            right={key: _text(value) for key, value in right.items()},
            tries=int(tries or 0),
            min_seconds=least or 0,
            max_seconds=most or 0,
        )

    # Rules and ends

    def _rule(self, text: Any, path: KeyPath) -> str:
        """Check that a rule can be read, and return it; "" if there is none."""
        if is_blank(text):
            return ""
        rule = _text(text)
        try:
            if isinstance(text, dict | list):
                raise rules.BadRule('must be one rule, such as answers.consent.agree == "yes"')
            for mention in rules.mentioned(rule):
                self._check_names(mention, rule)
        except rules.BadRule as error:
            first = re.match(r"(?:not\s+)?([A-Za-z]\w*)[.\s]", rule)
            if first and first[1] in self._all_names:
                self._wrong(path, f"{first[1]} is a step; write answers.{first[1]}")
            else:
                self._wrong(path, str(error))
            return ""
        return rule

    def _check_names(self, mention: tuple[str, ...], rule: str) -> None:
        """Raise `BadRule` if a rule asks about a step or a factor that is not there, or comes later."""
        design_ = self.design
        keys = {step.key for step in design_.steps}
        if mention[0] == "answers" and len(mention) > 1 and (design_.is_named and mention[1] not in keys):
            if mention[1] in self._all_names:
                raise rules.BadRule(f"{mention[1]} is asked later; a rule may ask about earlier steps only")
            raise rules.BadRule(f"there is no step {mention[1]}{did_you_mean(mention[1], keys)}")
        if mention[0] == "answers" and len(mention) == 3 and not _is_over_runs(mention, rule):
            self._check_run(mention)
        if mention[0] in ("condition", "order") and (len(mention) != 2 or mention[1] not in self._factors):
            name = mention[1] if len(mention) > 1 else ""
            raise rules.BadRule(f"there is no factor {name}{did_you_mean(name, self._factors)}")

    def _check_run(self, mention: tuple[str, ...]) -> None:
        """Raise `BadRule` if a rule outside of a block asks for a field of its steps, and not for that of one run."""
        step = next((step for step in self.design.steps if step.key == mention[1]), None)
        if step is None or step.block is None or step.block == self._block_now:
            return
        block = self.design.blocks[step.block]
        level = "-".join(block.runs[0])
        factors = " and ".join(factor.name for factor in block.factors)
        raise rules.BadRule(
            f"answers.{step.key} has an answer for each {factors}; write answers.{step.key}.{level}.{mention[2]}, or "
            f"sum(answers.{step.key}.{mention[2]})"
        )

    def _ends(self, written: Any) -> None:
        if is_blank(written):
            return
        if not isinstance(written, dict):
            self._wrong(ENDS, 'must be a map of ends and their rules, such as declined: answers.consent.agree == "no"')
            return
        ends = []
        for name, value in written.items():
            path = (*ENDS, name)
            if not _NAME.fullmatch(name):
                self._wrong(path, "an end's name has letters, digits and _")
                continue
            if end := self._end(name, value if isinstance(value, dict) else {"when": value}, path):
                ends.append(end)
        self.design.ends = tuple(ends)

    def _end(self, name: str, settings: dict[str, Any], path: KeyPath) -> End | None:
        for key in settings.keys() - {*END_KEYS}:
            self._wrong(
                (*path, key),
                f"unknown setting of an end{did_you_mean(str(key), END_KEYS)}; it has {', '.join(END_KEYS)}",
            )
        rule_given = settings.get("when")
        some = rule_given if isinstance(rule_given, list) else [] if is_blank(rule_given) else [rule_given]
        rules = [self._rule(rule, (*path, "when") if "when" in settings else path) for rule in some]
        minutes = self._number(settings.get("minutes"), (*path, "minutes"), 1, 100_000)
        if not some and minutes is None and name not in (COMPLETE, FAILED):
            self._wrong(path, f'nobody comes to this end: write {name}: answers.consent.agree == "no", or minutes: 60')
        code, link, page = (_text(settings.get(key, "")) for key in ("code", "link", "page"))
        if code and not _CODE.fullmatch(code):
            self._wrong((*path, "code"), "has letters, digits, - and _ only, 64 at most")
        if link and not link.startswith("https://"):
            self._wrong((*path, "link"), "must be an address that begins with https://")
        if page:
            try:
                page = step_file(page)
            except ValueError as error:
                self._wrong((*path, "page"), str(error))
        return End(name, tuple(filter(None, rules)), minutes, page, code, link)

    def _number(self, value: Any, path: KeyPath, least: int, most: int, *, whole: bool = False) -> float | None:
        if is_blank(value):
            return None
        check = values.whole(least, most) if whole else values.number(least, most)
        try:
            return float(str(check(value)))
        except ValueError as error:
            self._wrong(path, str(error))
            return None


def _names_in(item: Any) -> Iterator[str]:
    """The names of the steps in an item of the list, also of those in a block."""
    if isinstance(item, dict) and "each" in item:
        for inner in item["steps"] if isinstance(item.get("steps"), list) else ():
            yield from _names_in(inner)
    elif isinstance(item, dict):
        yield from (str(name).removesuffix(".html") for name in item)
    elif not isinstance(item, list) and not is_blank(item):
        yield _text(item).removesuffix(".html")


def _is_over_runs(mention: tuple[str, ...], rule: str) -> bool:
    """Whether the rule asks for a field of all runs, such as `sum(answers.trust.q1)`."""
    return re.search(rf"\b({'|'.join(rules.FUNCTIONS)})\(\s*{re.escape('.'.join(mention))}\s*\)", rule) is not None


def _page_name(value: Any) -> str:
    """The name of a page's file without `.html`. It may hold `{factor}`. Raises ValueError."""
    text = _text(value)
    return text if step_file(_FACTOR.sub("x", text)) and "{" in text else step_file(text)


def _text(value: Any) -> str:
    return value.text if isinstance(value, Plain) else str(value)


def _level(value: Any) -> Any:
    """The value of a level: a number stays one, everything else is text as written."""
    if isinstance(value, Plain) and not isinstance(value.value, bool):
        return value.value
    return _text(value) if isinstance(value, Plain) else value


def _texts(value: Any, path: KeyPath) -> Iterator[tuple[KeyPath, str]]:
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict | list) and len(path) < MAX_DEPTH:
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _texts(inner, (*path, key))


# The sections of games


def with_sections(design: Design, base: TrialSection) -> list[Step]:
    """Return the steps, with the sections that each game has at the levels that it names.

    `base` is the checked section `trial` at the first levels. Mistakes are added to `design.mistakes`.
    """
    steps, count = [], 0
    plain = base.document()
    for step in design.steps:
        sections = [*_sections(design, step, plain)] if step.type.on_server else []
        count += len(sections)
        steps.append(msgspec.structs.replace(step, sections=tuple(section for section in sections if section.trial)))
    if count > MAX_SECTIONS:
        design.mistakes.append(
            Mistake(STEPS, f"the games have {count} different settings in all; at most {MAX_SECTIONS}")
        )
    return steps


def _written(design: Design, step: Step) -> dict[str, Any]:
    """The section `trial` of a game as written: the study's, with the game's own keys. Its options are added."""
    study = design.trial if isinstance(design.trial, dict) else {}
    own = design.own_trial.get(step.key, {})
    options = study.get("options"), own.get("options")
    both = all(isinstance(part, dict) for part in options)
    return {**study, **own, **({"options": {**options[0], **options[1]}} if both else {})}  # type: ignore[dict-item]


def _sections(design: Design, step: Step, plain: Mapping[str, Any]) -> Iterator[Section]:
    block = design.blocks[step.block] if step.block is not None else None
    within = block.factors if block else ()
    factors = {factor.name: factor for factor in (*design.conditions, *within)}
    everywhere = {factor.name for other in design.blocks for factor in other.factors}
    written = _written(design, step)
    if factors or everywhere:
        for path, text in _texts(written, ()):
            for name in _FACTOR.findall(text):
                if name not in factors:
                    design.mistakes.append(_unknown_factor(design, step, path, name))
                    return
    factors_used = [factors[name] for name in factors if name in named_factors(written)]
    for cell in itertools.product(*(factor.levels.items() for factor in factors_used)):
        levels = {factor.name: name for factor, (name, _) in zip(factors_used, cell, strict=True)}
        section_filled = filled(
            written, {factor.name: value for factor, (_, value) in zip(factors_used, cell, strict=True)}
        )
        section, problems = check_trial(section_filled)
        own = design.own_trial.get(step.key, {})
        mistakes = [problem for problem in problems if problem.path[:1] and (problem.path[0] in own or factors_used)]
        if mistakes:
            at = f" (with {', '.join(f'{name}: {level}' for name, level in levels.items())})" if levels else ""
            for path, sentence, _ in mistakes[:1]:
                where = (*design.paths[step.key], *path) if path[0] in own else ("trial", *path)
                design.mistakes.append(Mistake(where, f"{sentence}{at}"))
            return
        document = section.document()
        yield Section(levels, {key: value for key, value in document.items() if value != plain.get(key)})


def _unknown_factor(design: Design, step: Step, path: KeyPath, name: str) -> Mistake:
    """The mistake that a text of a game names a factor that the game does not have."""
    within = {factor.name for block in design.blocks for factor in block.factors}
    own = path[0] in design.own_trial.get(step.key, {})
    where = (*design.paths[step.key], *path) if own else ("trial", *path)
    if name in within and not own:
        key = ".".join(map(str, path))
        return Mistake(
            design.paths[step.key],
            f"the game {step.key} takes {key} from trial, with {{{name}}}, and is outside of each: {name}; "
            f"give it {path[0]} of its own",
        )
    return Mistake(
        where,
        f"there is no factor {name}{did_you_mean(name, [*within, *(factor.name for factor in design.conditions)])}",
    )
