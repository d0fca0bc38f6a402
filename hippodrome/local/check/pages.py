"""Checks step pages: the text of each, and where the study shows it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from jinja2 import meta

from hippodrome.bots.page import leads_elsewhere
from hippodrome.control.config import Config, Diagnostic
from hippodrome.control.config.layout import PAGES
from hippodrome.control.config.step_files import StepFileError, open_folder
from hippodrome.control.participants import markup, sandbox
from hippodrome.control.participants.files import MAX_BYTES
from hippodrome.local.check.earlier_answers import EarlierAnswers, every_branch, source_of
from hippodrome.local.check.page_source import PageSource
from hippodrome.local.check.structure import check_structure
from hippodrome.local.check.tags import Tags
from hippodrome.local.check.templates import Visitors, check_template
from hippodrome.protocol.values import printable


def check_pages(folder: Path, config: Config | None) -> list[Diagnostic]:
    """Return the problems of the study's pages.

    If the configuration cannot be read, these are the problems of all pages in the folder.
    """
    try:
        steps = open_folder(folder)
    except StepFileError:
        return []
    of_hippo = steps.path.name != PAGES[0]  # HIPPO shows its pages whatever is wrong in them, and so do we
    diagnostics: list[Diagnostic] = []
    for name, groups in _pages(steps.names, config).items():
        try:
            source = (steps.path / name).read_bytes().decode("utf-8", "replace")
        except OSError:
            continue  # the check of the configuration reports it
        label = f"{steps.path.name}/{name}"
        earlier = EarlierAnswers.before_page(steps.path, config, name)
        send_it = config is not None and _is_sent(config, name, source)
        page = PageSource(source)
        here = [
            *check_template(label, source, config, Visitors(groups, earlier, send_it)),
            *Tags(label, steps.names, config).read(page),
            *(replace(problem, remark=problem.remark or of_hippo) for problem in check_structure(label, page)),
        ]
        diagnostics += sorted(dict.fromkeys(here), key=lambda problem: problem.line or 0)
    return diagnostics + (_of_all(steps.path, steps.names, config) if config else [])


def _of_all(folder: Path, names: Iterable[str], config: Config) -> list[Diagnostic]:
    """Problems that follow from where the study shows its pages."""
    used = _pages(names, config)
    unused = sorted(name for name in names if name.endswith(".html") and name not in used)
    diagnostics = [_unused(folder, unused)] if unused else []
    if config.project.use_aws:
        diagnostics += [_too_large(folder, name) for name in sorted(names) if _size(folder / name) > MAX_BYTES]
    if not config.project.keeps_off_aws and not config.project.signed_links:  # strangers may come, from a recruiter
        last = dict.fromkeys(file.name for file in config.steps[-1].files)
        diagnostics += [_no_code(f"{folder.name}/{name}") for name in last if not _leads_back(source_of(folder / name))]
    return diagnostics


def _is_sent(config: Config, name: str, source: str) -> bool:
    """Whether participants have to send this page to go on: the last page only if it has fields."""
    *others, last = [[file.name for file in step.files] for step in config.steps]
    return any(name in files for files in others) or (name in last and every_branch(source).has_fields)


def _unused(folder: Path, names: list[str]) -> Diagnostic:
    """One remark on all pages that no step shows: a clone of HIPPO Gym may have the pages of several studies."""
    if len(names) == 1:
        message = "no step shows this page; name it under project.steps, or delete it"
        return Diagnostic(f"{folder.name}/{names[0]}", None, "", message, remark=True)
    listed = printable(", ".join(names), 1000)
    message = f"no step shows these pages; name them under project.steps, or delete them: {listed}"
    return Diagnostic(f"{folder.name}/", None, "", message, remark=True)


def _size(file: Path) -> int:
    return file.stat().st_size if file.is_file() and not file.name.startswith(".") else 0


def _too_large(folder: Path, name: str) -> Diagnostic:
    message = (
        f"larger than {MAX_BYTES // 1024**2} MB, which AWS does not serve; make it smaller, or put it on another site"
    )
    return Diagnostic(f"{folder.name}/{name}", None, "", message)


def _no_code(label: str) -> Diagnostic:
    message = (
        "this last page shows no completion code and no link: those who come from a recruiting site need one; "
        "write {{ completion_code }}, or a link back to the site"
    )
    return Diagnostic(label, None, "", message, remark=True)


def _leads_back(source: str) -> bool:
    """Whether a last page has a completion code, or leads to another site (docs/recruiting.md)."""
    try:
        if "completion_code" in meta.find_undeclared_variables(sandbox.environment().parse(source)):
            return True
    except Exception:  # noqa: BLE001 - the check of the page reports what Jinja cannot read
        return True
    for token in markup.tokens(every_branch(source).html):
        attributes = markup.attributes(token.attributes)
        address = attributes.get("href", "").strip() if token.start == "a" else ""
        if leads_elsewhere(address) or address.startswith(markup.MARK):
            return True
        if "code" in attributes.get("class", "").split() or (token.start == "script" and "://" in token.content):
            return True
    return False


def _pages(names: Iterable[str], config: Config | None) -> dict[str, list[int | None]]:
    """The files of the pages in the study's order, and the groups that may see each."""
    if config is None:
        return {name: [None] for name in names if name.endswith(".html")}
    pages: dict[str, list[int | None]] = {}
    for step in (*config.steps, *config.game_pages):
        for group, file in enumerate(step.files):
            pages[file.name] = [group] if step.variants else config.each_group
    for name in config.end_pages:
        pages.setdefault(name, config.each_group)
    return pages
