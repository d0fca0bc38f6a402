"""Registers a project folder and copies its pages to the documents."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from hippodrome.control.config import Config, ConfigErrors, layout, read_project
from hippodrome.control.config.step_order import changed_pages
from hippodrome.control.model.project import MASTER_LIST, read_list
from hippodrome.control.ports import Conflict, Documents
from hippodrome.functions import update_project_master_list
from hippodrome.protocol.file_names import composed

CHANGED = (
    "The steps changed, and people have begun: {steps}. Answers keep the number of their step, and each participant "
    "goes on at the first step without an answer, so some may see a page twice or not at all. To begin anew, give the "
    "study another id"
)


class NotPublished(Exception):
    """The project cannot be published; `problems` are sentences for the researcher."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def publish(
    folder: Path,
    documents: Documents,
    subdomain: str | None = None,
    say: Callable[[str], None] = lambda _: None,
    *,
    signed: bool = False,
) -> Config:
    """Check the project, copy its pages where they differ, and register it; return the project.

    `subdomain` replaces the project's. With `signed`, as in a lab, links are signed whatever it says, and settings that
    others of the network could misuse are refused. `say` gets a sentence if steps have changed and participants have
    begun. Raises `NotPublished`.
    """
    try:
        config = read_project(folder)
    except ConfigErrors as errors:
        raise NotPublished([str(problem) for problem in errors.diagnostics]) from None
    if signed and (refused := list(_not_in_a_lab(config))):
        raise NotPublished(refused)
    for file in [*step_files(folder), *config.own_pages]:
        _put(documents, f"{config.project.id}/steps/{composed(file.name)}", file.read_bytes())
    # On this machine servers are processes, also if the project says that they run on AWS.
    registration = {**config.registration(), "useAWS": False}
    if signed:
        registration["signedLinks"] = True
    if subdomain is not None:
        registration["subdomain"] = subdomain
    changed = _changed(documents, config)
    answer: dict[str, Any] = update_project_master_list.handler({"project": registration}, None)
    if answer.get("problems"):
        raise NotPublished(list(answer["problems"]))
    if changed:
        say(CHANGED.format(steps=changed))
    return config


def _not_in_a_lab(config: Config) -> Iterator[str]:
    """Yield a sentence for each setting that others of the network could misuse."""
    if config.project.subdomain == "userId":
        yield (
            "project.subdomain is userId, which a lab's server (--host) does not allow: servers must not be "
            "found by participants' ids; use hash"
        )
    if config.project.plain_clients:
        yield (
            "project.plainClients is true, which a lab's server (--host) does not allow: anyone in the network could "
            "play as any participant"
        )


def _changed(documents: Documents, config: Config) -> str:
    """The steps whose page is another one now, in words; empty if there are none, or if no participant has begun."""
    document = documents.get(MASTER_LIST)
    try:
        before = read_list(document.body).find(config.project.id) if document else None
    except ValueError:  # the registration below reports a list that cannot be read
        return ""
    if before is None:
        return ""
    changed = changed_pages(
        {step.key: step.page for step in before.steps}, {step.key: step.page for step in config.steps}
    )
    begun = changed and any(True for _ in documents.list(f"{config.project.id}/users/"))
    return changed if begun else ""


def step_files(folder: Path) -> list[Path]:
    """Return the files in the folder of pages, sorted: pages, pictures and the like, without hidden files."""
    pages = layout.pages_folder(folder)
    page_paths = pages.iterdir() if pages else ()
    return sorted(file for file in page_paths if file.is_file() and not file.name.startswith("."))


def _put(documents: Documents, key: str, body: bytes) -> None:
    """Write the document, unless it has this content already."""
    while True:
        document = documents.get(key)
        if document and document.body == body:
            return
        try:
            if document:
                documents.replace(key, body, document.etag)
            else:
                documents.create(key, body)
        except Conflict:
            continue
        return
