"""Makes a copy of a registered study for bots, and removes the copy with all documents of the bots.

The study itself is not touched: the copy is a project with its own id and its own pages, so the bots' answers are never
stored among the participants'. It runs the study's image, by its task definition.
"""

from __future__ import annotations

import contextlib
import re
import secrets
from collections.abc import Callable, Iterable
from datetime import datetime, timedelta

import msgspec

from hippodrome.console.problem import Problem
from hippodrome.control.lobby import decisions, entries
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.model.project import MASTER_LIST, STEPS_FOLDER, MasterList, Project, read_list, write_list
from hippodrome.control.model.records import from_json
from hippodrome.control.ports import Conflict, Documents, Platform
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core import participants
from hippodrome.deployment.core.project_folder import registration_of
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.operate.eraser import Eraser
from hippodrome.deployment.study import links
from hippodrome.deployment.study.register import invoke
from hippodrome.protocol.keys import questions_folder

ID = re.compile(r"rehearsal-[0-9a-f]{32}")  # no researcher names a study like this
MAX_RUNTIME = 30  # minutes: no server lives longer, even if the rehearsal is killed
OLD = timedelta(hours=2)  # a rehearsal takes minutes, so a copy of this age is a leftover
TRIES = 20  # attempts to write the list of projects
CONTROLS = ("left", "right", "up", "down", "start", "pause")  # the controls of a game whose `trial` section has no `ui`


class Copy:
    """The copy of a study. `make` registers it; before that, `project` must not be used."""

    def __init__(self, account: Account, installation: Installation, platform: Platform) -> None:
        self.id = f"rehearsal-{secrets.token_hex(16)}"
        self.users: list[str] = []
        self._account = account
        self._installation = installation
        self._platform = platform
        self._made: Project | None = None

    @property
    def project(self) -> Project:
        """The copy as it is registered. Raises AssertionError before the copy is made."""
        assert self._made is not None, "not made yet"
        return self._made

    def make(self, of: Project) -> int:
        """Copy the pages of the project `of`, register the copy, and return the number of pages.

        Raises `Problem` if the installation does not take the registration.
        """
        documents = self._platform.documents
        for key, name in (pages := page_files(documents, of)).items():
            document = documents.get(key)
            if document is not None:
                documents.create(f"{self.id}/{STEPS_FOLDER}/{name}", document.body)
        invoke(self._account, self._installation, registration_of(changed(of, self.id), live=True))
        self._made = next(
            (
                registration
                for registration in participants.registered_projects(documents, [])
                if registration.id == self.id
            ),
            None,
        )
        if self._made is None:
            raise Problem("The copy was registered, and is not in the list of projects.", "Run it again.")
        return len(pages)

    def user(self, name: str) -> str:
        """Add a bot, and return its id."""
        self.users.append(f"bot-{self.id.rpartition('-')[2][:8]}-{name}")
        return self.users[-1]

    def link(self, user_id: str) -> str:
        """Return the signed link of a bot."""
        (signature,) = links.signed(self._account, self._installation, self.id, [user_id]).values()
        return links.link(self._installation["Site"], self.project, user_id, signature)

    def remove(self, progress: Callable[[str], None] = lambda _: None) -> int:
        """Remove servers, documents in all versions, and the registration. Return how many versions were deleted."""
        return remove(self._account, self._installation, self._platform, self.id, users=self.users, progress=progress)


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


def left_behind(documents: Documents, now: datetime) -> list[str]:
    """Return the ids of the copies that rehearsals have left behind because they were killed.

    Copies that are younger than `OLD` are left out: their rehearsals may still run.
    """
    ids = [project.id for project in participants.registered_projects(documents, []) if ID.fullmatch(project.id)]
    return [project_name for project_name in ids if _age(documents, project_name, now) > OLD]


def _age(documents: Documents, project_id: str, now: datetime) -> timedelta:
    first = next(iter(documents.list(f"{project_id}/steps/")), None)
    return now - first.modified if first else OLD * 2


def remove(
    account: Account,
    installation: Installation,
    platform: Platform,
    project_id: str,
    *,
    users: Iterable[str] | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> int:
    """Remove a copy by its id, with all bots in `users` or with documents. Return how many versions were deleted.

    Without `users`, this searches the records of all servers, too, since a bot may have no other document. Raises
    `Problem` if something of a bot is left.
    """
    progress("removing the copy of the study from the list")
    unregister(platform.documents, project_id)
    users_known = dict.fromkeys(
        [*(users or ()), *(user for user, _ in participants.folders(platform.documents, project_id))]
    )
    users_known |= dict.fromkeys(_lobby_sessions(platform.documents, project_id))
    if users is None:
        records = Records(platform.documents).since()
        users_known |= dict.fromkeys(record.user_id for record in records if record.project_id == project_id)
    bucket = VersionedBucket(account, installation["Bucket"])
    lobby = (entries.folder(project_id), decisions.key(project_id), questions_folder(project_id))
    deleted = sum(bucket.delete(bucket.versions(place)) for place in lobby)
    for number, user in enumerate(users_known, 1):
        progress(f"removing what is left of bot {number} of {len(users_known)}")
        eraser = Eraser(account, installation, project_id, user, late=False)
        if eraser.run():
            raise Problem("Something of a bot is still there.", f"Run `hippodrome stop {project_id}`.")
        deleted += sum(sum(counts.values()) - counts["bytes"] for counts in eraser.receipt.deleted.values())
    progress("removing the pages")
    return deleted + bucket.delete(bucket.versions(f"{project_id}/"))


def _lobby_sessions(documents: Documents, project_id: str) -> list[str]:
    """Return the ids of sessions in the lobby's decisions, also of those with a server ahead and without members."""
    document = documents.get(decisions.key(project_id))
    try:
        return sorted(from_json(document.body, Decisions).session_ids()) if document else []
    except ValueError:  # the sweep stops servers that no lobby lists
        return []


def unregister(documents: Documents, project_id: str) -> None:
    """Remove a project from the list of projects, if it is there. Raises `Problem` after `TRIES` conflicts."""
    for _ in range(TRIES):
        document = documents.get(MASTER_LIST)
        listed = read_list(document.body) if document else MasterList()
        if document is None or listed.find(project_id) is None:
            return
        master_list = MasterList(
            [project for project in listed.projects if project.id != project_id], listed.unreadable
        )
        with contextlib.suppress(Conflict):
            documents.replace(MASTER_LIST, write_list(master_list), document.etag)
            return
    raise Problem("The list of projects is being written all the time.", "Run it again.")
