"""Makes a copy of a registered study for bots, and removes the copy with all servers and documents of the bots.

The study itself is not touched: the copy is a project with its own id and its own pages, so the bots' answers are never
stored among the participants'. It runs the study's image, by its task definition.
"""

from __future__ import annotations

import contextlib
import re
import secrets
import time
from collections.abc import Callable
from datetime import datetime, timedelta

import msgspec

from hippodrome.console.problem import Problem
from hippodrome.control.lobby import decisions, entries
from hippodrome.control.model import server
from hippodrome.control.model.balance import cells_key
from hippodrome.control.model.project import MASTER_LIST, STEPS_FOLDER, MasterList, Project, read_list, write_list
from hippodrome.control.model.server import Server
from hippodrome.control.ports import Conflict, Documents
from hippodrome.control.servers.leftovers import Scope
from hippodrome.control.storage.project_cache import FRESH
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import participants
from hippodrome.deployment.core.project_folder import registration_of
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.operate.stop import Stopper
from hippodrome.deployment.study import links
from hippodrome.deployment.study.register import invoke
from hippodrome.protocol.keys import questions_folder

ID = re.compile(r"rehearsal-[0-9a-f]{32}")  # no researcher names a study like this
MAX_RUNTIME = 30  # minutes: no server lives longer, even if the rehearsal is killed
OLD = timedelta(hours=2)  # a rehearsal takes minutes, so a copy of this age is a leftover
GONE = 240  # seconds until its servers must have ended: stopTimeout is 120
TRIES = 20  # attempts to write the list of projects
CONTROLS = ("left", "right", "up", "down", "start", "pause")  # the controls of a game whose `trial` section has no `ui`


class StudyCopy:
    """The copy of a study. `make` registers it; before that, `project` must not be used."""

    def __init__(self, context: CheckContext, copy_id: str = "") -> None:
        self.id = copy_id or f"rehearsal-{secrets.token_hex(16)}"
        self.project: Project
        self._context = context
        self._documents = context.platform.documents

    def make(self, of: Project) -> int:
        """Copy the pages of the project `of`, register the copy, and return the number of pages.

        Functions know the copy when this returns. Raises `Problem` if the installation refuses the registration.
        """
        for key, name in (pages := page_files(self._documents, of)).items():
            document = self._documents.get(key)
            if document is not None:
                self._documents.create(f"{self.id}/{STEPS_FOLDER}/{name}", document.body)
        invoke(self._context.account, self._context.installation, registration_of(changed(of, self.id), live=True))
        registered = participants.registered_projects(self._documents, [])
        (self.project,) = participants.choose(registered, self.id)
        _until_functions_know()
        return len(pages)

    def user(self, name: str) -> str:
        """Return a bot's id."""
        return f"bot-{self.id.rpartition('-')[2][:8]}-{name}"

    def link(self, user_id: str) -> str:
        """Return the signed link of a bot."""
        installation = self._context.installation
        (signature,) = links.signed(self._context.account, installation, self.id, [user_id]).values()
        return links.link(installation["Site"], self.project, user_id, signature)

    def remove(self, progress: Callable[[str], None] = lambda _: None) -> tuple[int, list[Server]]:
        """Remove the registration, the servers, and all documents.

        Return how many versions of documents were deleted, and the records of the servers. May be interrupted anywhere:
        its folder is deleted last, and leads the next rehearsal here. Raises `Problem` if a server does not end.
        """
        progress("removing the copy of the study from the list")
        unregister(self._documents, self.id)
        _until_functions_know()  # from now on, no function starts a server of the copy
        progress("stopping its servers")
        stopper = Stopper(self._context.platform, Scope(project_id=self.id, without_record=True))
        if stopper.run(GONE):
            raise Problem("A server of the copy still runs.", "Run `hippodrome stop --all`.", [*stopper.errors])
        progress("removing pages, answers and recordings")
        bucket = VersionedBucket(self._context.account, self._context.installation["Bucket"])
        recent = Records(self._documents).since(_made_at(self._documents, self.id))
        records = [record for record in recent if record.project_id == self.id]
        places = [
            *(server.key(record.label) for record in records),
            entries.folder(self.id),
            decisions.key(self.id),
            questions_folder(self.id),
            cells_key(self.id),
            f"{self.id}/",
        ]
        return sum(bucket.delete(bucket.versions(place)) for place in places), records


def _until_functions_know() -> None:
    time.sleep((FRESH + timedelta(seconds=1)).total_seconds())


def changed(project: Project, new_id: str) -> Project:
    """Change the study for bots: they have signed links and may stop the game; no limits, no warm servers."""
    ui = project.trial.get("ui") or dict.fromkeys(CONTROLS, True)
    return msgspec.structs.replace(
        project,
        id=new_id,
        live=True,
        signed_links=True,
        max_runtime=min(project.max_runtime, MAX_RUNTIME),
        page_folder=STEPS_FOLDER,
        max_participants=None,
        max_servers=None,
        max_server_hours=None,
        warm_servers=0,
        subdomain="hash",
        plain_clients=False,
        front_end=[],
        cluster="installation",
        trial={**project.trial, "ui": {**ui, "stop": True}},
    )


def page_files(documents: Documents, of: Project) -> dict[str, str]:
    """Return, by key, the file name of a project's pages and of the files beside them."""
    prefix = f"{of.id}/{STEPS_FOLDER}/"
    page_files = {entry.key: entry.key.removeprefix(prefix) for entry in documents.list(prefix)}
    if of.page_folder == STEPS_FOLDER:
        return page_files
    pages = {of.page_key(file): f"{file}.html" for step in (*of.steps, *of.pages_in_game) for file in step.files}
    return {key: name for key, name in page_files.items() if name not in pages.values()} | pages


def left_behind(context: CheckContext, now: datetime) -> list[str]:
    """Return the ids of the copies that rehearsals have left behind because they were killed.

    Copies that are younger than `OLD` are left out: their rehearsals may still run.
    """
    bucket = VersionedBucket(context.account, context.installation["Bucket"])
    copies = {name: _made_at(context.platform.documents, name) for name in bucket.folders() if ID.fullmatch(name)}
    return [name for name, made_at in copies.items() if made_at is None or now - made_at > OLD]


def _made_at(documents: Documents, copy_id: str) -> datetime | None:
    """Return when the pages of a copy were written; None if they are deleted already."""
    return min((entry.modified for entry in documents.list(f"{copy_id}/{STEPS_FOLDER}/")), default=None)


def unregister(documents: Documents, project_id: str) -> None:
    """Remove a project from the list of projects, if it is there. Raises `Problem` after `TRIES` conflicts."""
    for _ in range(TRIES):
        document = documents.get(MASTER_LIST)
        listed = read_list(document.body) if document else MasterList()
        if document is None or listed.find(project_id) is None:
            return
        others = [project for project in listed.projects if project.id != project_id]
        with contextlib.suppress(Conflict):
            documents.replace(MASTER_LIST, write_list(MasterList(others, listed.unreadable)), document.etag)
            return
    raise Problem("The list of projects is being written all the time.", "Run it again.")
