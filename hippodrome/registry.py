"""`update_project_master_list`: add a project, or put a new version in its place, also when two do so at once."""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from hippodrome.config import ConfigErrors, parse_registration
from hippodrome.limits.slots import Slots
from hippodrome.log import failure, logger
from hippodrome.model import ids
from hippodrome.model.project import MASTER_LIST, MIN_WARM_WAIT, MasterList, Project, read_list, step_key, write_list
from hippodrome.ports import Conflict, Platform
from hippodrome.servers.warm.pools import Pools
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.secret import Secrets

TRIES = 20
MOST_SIGNED = 5_000  # links at once


class NotRegistered(Exception):
    """The project cannot be registered; `problems` says why, a sentence each."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(self.problems))


def register(platform: Platform, registration: object) -> Project:
    """Check a registration (see `hippodrome.config`), and write it to the master list. Raises `NotRegistered`."""
    project = _parse(registration)
    problems = [*_not_allowed_here(platform, project), *_missing_files(platform, project)]
    if problems:
        raise NotRegistered(problems)
    _set_participant_limit(platform, project)
    keys = Secrets(platform.documents)
    keys.get_or_create()  # before anything is written that is nothing without it
    for _ in range(TRIES):
        found = platform.documents.get(MASTER_LIST)
        listed = _master_list(found.body) if found else MasterList()
        before = listed.find(project.id)
        keys.add_project_secrets(listed.secrets())
        salt = listed.salt(project.id)  # a secret that was taken over goes without one
        salt = secrets.token_hex(8) if salt is None else salt
        entry = msgspec.structs.replace(project, salt=salt, version=secrets.token_hex(4))
        body = write_list(listed.without_secrets().with_project(entry))
        try:
            if found:
                platform.documents.replace(MASTER_LIST, body, found.etag)
            else:
                platform.documents.create(MASTER_LIST, body)
        except Conflict:
            continue
        _set_participant_limit(platform, project)  # who came meanwhile
        logger.info("registered", extra={"project": project.id, "live": project.live})
        if entry.warm_servers or (before and before.warm_servers):
            _warm_up(platform, entry)
        return entry
    raise NotRegistered(["too many registrations at this moment; please try again"])


def migrate_secrets(platform: Platform) -> int:
    """Move the secrets out of the master list that an earlier version wrote into it; how many. They stay valid."""
    keys = Secrets(platform.documents)
    for _ in range(TRIES):
        found = platform.documents.get(MASTER_LIST)
        listed = _master_list(found.body) if found else MasterList()
        known = listed.secrets()
        if found is None or not known:
            return 0
        keys.add_project_secrets(known)
        try:
            platform.documents.replace(MASTER_LIST, write_list(listed.without_secrets()), found.etag)
        except Conflict:
            continue
        logger.info("secrets were taken out of the list", extra={"count": len(known)})
        return len(known)
    raise NotRegistered(["too many registrations at this moment; please try again"])


def _master_list(body: bytes) -> MasterList:
    """The master list. Raises `NotRegistered` if it is none: then nothing must be written over it."""
    try:
        return read_list(body)
    except (ValueError, RecursionError) as error:
        failure("the list of projects cannot be read", error)
        text = f"{MASTER_LIST} cannot be read; the bucket keeps older versions: put the last good one in its place"
        raise NotRegistered([text]) from None


def _warm_up(platform: Platform, project: Project) -> None:
    """Warm servers are started, replaced or told to go; if that cannot be asked for now, the sweep does it."""
    try:
        Pools(platform, ProjectCache(platform)).request_adjustment(project.id)
    except Exception as error:  # noqa: BLE001 - the project is registered
        failure("warm servers are left to the sweep", error, project=project.id)


def _set_participant_limit(platform: Platform, project: Project) -> None:
    """Participants who came before there was a limit count as well."""
    if project.max_participants is None:
        return
    folders = (entry.key.split("/") for entry in platform.documents.list(f"{project.id}/users/"))
    Slots(platform).set_limit(project, [rest[0] for _, _, *rest in folders if rest[1:] == ["participant.json"]])


def _parse(registration: object) -> Project:
    try:
        checked = parse_registration(registration)
    except ConfigErrors as errors:
        raise NotRegistered(f"{p.where}: {p.message}" for p in errors.diagnostics) from None
    return msgspec.convert(checked, Project)


def _not_allowed_here(platform: Platform, project: Project) -> Iterable[str]:
    """A project meant for another installation's bucket or domain is refused here, or what this one does not allow."""
    setup, here = project.aws_setup, platform.settings
    if project.subdomain == "userId" and not here.user_id_names:
        yield "project.subdomain is userId, which this installation's parameter ServerNames does not allow; use hash"
    if project.live and project.warm_servers and project.max_runtime + MIN_WARM_WAIT > here.max_runtime:
        yield (
            f"project.warmServers is {project.warm_servers}: with an hour of waiting and maxRuntime, a server may need "
            f"{project.max_runtime + MIN_WARM_WAIT} minutes, and this installation allows {here.max_runtime}"
        )
    if not project.use_a_w_s or setup is None:
        return
    if setup.bucket and here.bucket and setup.bucket != here.bucket:
        yield f"project.awsSetup.bucket is {setup.bucket}, but this installation's bucket is {here.bucket}"
    if setup.root_domain and here.root_domain and setup.root_domain.lower() != here.root_domain:
        yield f"project.awsSetup.rootDomain is {setup.root_domain}, but this installation's is {here.root_domain}"
    if project.max_runtime > here.max_runtime:
        yield f"project.maxRuntime is {project.max_runtime} minutes; this installation allows {here.max_runtime}"


def _missing_files(platform: Platform, project: Project) -> Iterable[str]:
    """Step files that the project names and nobody uploaded."""
    there = {entry.key for entry in platform.documents.list(f"{project.id}/steps/")}
    for step in project.steps:
        if not step.type.has_files:
            continue
        files = [f"{step.page}-{n}" for n in range(step.variants)] or [step.page]
        for file in files:
            if step_key(project.id, file) not in there:
                yield f"project.steps.{step.key}: {file}.html has not been uploaded"


def sign_links(platform: Platform, asked: object) -> list[str]:
    """What makes links to a project theirs whose ids these are, in the order of the ids. Raises `NotRegistered`."""
    project_id = asked.get("projectId") if isinstance(asked, Mapping) else None
    users = asked.get("userIds") if isinstance(asked, Mapping) else None
    if not isinstance(users, list) or len(users) > MOST_SIGNED or not all(map(ids.is_user_id, users)):
        raise NotRegistered([f"links: userIds must be a list of at most {MOST_SIGNED} ids"])
    project_cache = ProjectCache(platform, Secrets(platform.documents))
    project = project_cache.project(project_id) if isinstance(project_id, str) else None
    if project is None:
        raise NotRegistered(["links: no project of that id is registered"])
    return [ids.link_signature(project.secret, project.id, user) for user in users]


def handle(platform: Platform, event: Mapping[str, Any]) -> dict[str, Any]:
    """What the function returns: `{"registered": id, "live": …}` or `{"problems": […]}`.

    Asked for `{"links": {"projectId": …, "userIds": […]}}`, it returns `{"signatures": […]}` of signed links instead:
    researchers need those, and not the secret that makes them. Asked to `{"takeOver": true}`, it moves secrets out of a
    list that an earlier version wrote, and returns `{"takenOver": n}`.
    """
    try:
        if event.get("takeOver") is True:
            return {"takenOver": migrate_secrets(platform)}
        if "links" in event:
            return {"signatures": sign_links(platform, event["links"])}
        project = register(platform, event.get("project", event))
    except NotRegistered as error:
        return {"problems": error.problems}
    return {"registered": project.id, "live": project.live, "steps": len(project.steps)}
