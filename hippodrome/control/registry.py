"""`update_project_master_list`: adds or replaces a project in the master list, by compare-and-swap."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterable, Mapping
from typing import Any

import msgspec

from hippodrome.control.config import ConfigErrors, hippo_registration, parse_registration
from hippodrome.control.limits.slots import Slots
from hippodrome.control.log import failure, logger
from hippodrome.control.model import ids
from hippodrome.control.model.balance import Cells, cells_key
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import (
    GAME_PAGES,
    MASTER_LIST,
    MIN_RUNTIME_MARGIN,
    STEPS_FOLDER,
    MasterList,
    Project,
    read_list,
    write_list,
)
from hippodrome.control.model.records import from_data, from_json
from hippodrome.control.ports import Conflict, Document, Platform
from hippodrome.control.servers.warm.pools import Pools
from hippodrome.control.storage import uploaded_pages
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import SecretCache

TRIES = 20
MAX_SIGNED = 5_000  # the most links that one call signs
ALONE = (  # because functions look up a participant's session only in a project with several players
    "project.players: the study is registered with players: {players}, and participants who play together would be "
    "separated; give a study for one participant another project.id"
)
OTHER_FACTORS = (
    "project.conditions and each: {people} were assigned to levels and orders that the study would no longer have; "
    "give the changed study another project.id"
)

NOT_UTF8 = "the registration cannot be written as JSON in UTF-8: a text holds half of a character, or it is too deep"


class NotRegistered(Exception):
    """The request is refused; `problems` has a sentence for each reason."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = list(problems)
        super().__init__("; ".join(self.problems))


def register(platform: Platform, registration: object) -> Project:
    """Check a registration (`control.config`) and write it to the master list; return the project as registered.

    Raises `NotRegistered`.
    """
    return _enter(platform, _parse(registration))


def _enter(platform: Platform, project: Project) -> Project:
    """Write a project to the master list; return the entry. Raises `NotRegistered` if it cannot run here."""
    problems = [*_not_allowed_here(platform, project), *_missing_files(platform, project)]
    if problems:
        raise NotRegistered(problems)
    _set_participant_limit(platform, project)
    SecretCache(platform.documents).get_or_create()  # the secret must exist before anything that needs it is written
    for _ in range(TRIES):
        document, listed = _master_list(platform)
        before = listed.find(project.id)
        if before and before.has_sessions and not project.has_sessions:
            raise NotRegistered([ALONE.format(players=before.players)])
        if assigned := _assigned_to_others(platform, before, project):
            raise NotRegistered([OTHER_FACTORS.format(people=assigned)])
        salt = listed.salt(project.id) or secrets.token_hex(8)
        entry = msgspec.structs.replace(project.following(before), salt=salt, version=secrets.token_hex(4))
        body = write_list(listed.with_project(entry))
        try:
            if document:
                platform.documents.replace(MASTER_LIST, body, document.etag)
            else:
                platform.documents.create(MASTER_LIST, body)
        except Conflict:
            continue
        _set_participant_limit(platform, project)  # again, to count the participants who have come since
        logger.info("registered", extra={"project": project.id, "live": project.live})
        if entry.warm_servers or (before and before.warm_servers):
            _warm_up(platform, entry)
        return entry
    raise NotRegistered(["too many registrations at this moment; please try again"])


def _assigned_to_others(platform: Platform, before: Project | None, project: Project) -> str:
    """How many have been assigned, if this registration has other factors than the one before; "" if nobody has.

    On one machine, where studies are tried while they are written, any change is allowed.
    """
    if before is None or not project.use_a_w_s or before.factors == project.factors:
        return ""
    document = platform.documents.get(cells_key(project.id))
    people = sum(from_json(document.body, Cells).people.values()) if document else 0
    return f"{people:,} {'sessions' if project.has_sessions else 'people'}" if people else ""


def _master_list(platform: Platform) -> tuple[Document | None, MasterList]:
    """Return the document of the master list, and the list in it; None and an empty list if there is no document.

    Raises `NotRegistered` if the document cannot be read, so that it is not overwritten.
    """
    document = platform.documents.get(MASTER_LIST)
    if document is None:
        return None, MasterList()
    try:
        return document, read_list(document.body)
    except ValueError as error:
        failure("the list of projects cannot be read", error)
        text = f"{MASTER_LIST} cannot be read; the bucket keeps older versions: put the last good one in its place"
        raise NotRegistered([text]) from None


def _warm_up(platform: Platform, project: Project) -> None:
    """Request that the project's warm servers be started, replaced or drained. If that fails, the sweep does it."""
    try:
        Pools(platform, ProjectCache(platform)).request_adjustment(project.id)
    except Exception as error:  # noqa: BLE001 - the project is registered
        failure("warm servers are left to the sweep", error, project=project.id)


def _set_participant_limit(platform: Platform, project: Project) -> None:
    """Set the limit of participants. Participants who came before the study had a limit count as well."""
    if project.max_participants is None:
        return
    folders = (entry.key.split("/") for entry in platform.documents.list(f"{project.id}/users/"))
    Slots(platform).set_limit(project, [rest[0] for _, _, *rest in folders if rest[1:] == ["participant.json"]])


def _parse(registration: object) -> Project:
    try:
        checked = parse_registration(registration)
    except ConfigErrors as errors:
        raise NotRegistered(f"{p.where}: {p.message}" for p in errors.diagnostics) from None
    return from_data(checked, Project)


def _not_allowed_here(platform: Platform, project: Project) -> Iterable[str]:
    """Yield a sentence for each setting that names another installation, or that this installation does not allow."""
    setup, here = project.aws_setup, platform.settings
    if project.subdomain == "userId" and not here.user_id_names:
        yield "project.subdomain is userId, which this installation's parameter ServerNames does not allow; use hash"
    if project.plain_clients and not here.plain_clients:
        yield "project.plainClients is true, which this installation's parameter PlainClients does not allow"
    if project.live and project.warm_servers and project.max_runtime + MIN_RUNTIME_MARGIN > here.max_runtime:
        yield (
            f"project.warmServers is {project.warm_servers}: with an hour of waiting and maxRuntime, a server may need "
            f"{project.max_runtime + MIN_RUNTIME_MARGIN} minutes, and this installation allows {here.max_runtime}"
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
    """Yield a sentence for each step file that the project names and the bucket lacks."""
    pages = project.all_pages
    if project.page_folder == STEPS_FOLDER:
        uploaded = {entry.key for entry in platform.documents.list(f"{project.id}/{STEPS_FOLDER}/")}
    else:
        uploaded = uploaded_pages.at_top(platform.documents, project.id, {step.page for step in pages})
    missing = {  # a page that is repeated once
        f"{_place_in_config(project, page)}: {file}.html has not been uploaded": None
        for page in pages
        for file in page.files
        if project.page_key(file) not in uploaded
    }
    yield from missing


def _place_in_config(project: Project, page: Step) -> str:
    """Where config.yml names a page."""
    if page.key in GAME_PAGES:
        return f"trial.{page.key}"
    is_end = project.step(page.key) is None and any(end.name == page.key for end in project.ends)
    return f"project.ends.{page.key}.page" if is_end else f"project.steps.{page.step_name}"


def sign_links(platform: Platform, request: object) -> list[str]:
    """Return the signature of the link of each of `userIds` in `request`, in their order. Raises `NotRegistered`."""
    project_id = request.get("projectId") if isinstance(request, Mapping) else None
    users = request.get("userIds") if isinstance(request, Mapping) else None
    if not isinstance(users, list) or len(users) > MAX_SIGNED or not all(map(ids.is_user_id, users)):
        raise NotRegistered([f"links: userIds must be a list of at most {MAX_SIGNED} ids"])
    project_cache = ProjectCache(platform, SecretCache(platform.documents))
    project = project_cache.project(project_id) if isinstance(project_id, str) else None
    if project is None:
        raise NotRegistered(["links: no project with this projectId is registered"])
    return [ids.link_signature(project.secret, project.id, user) for user in users]


def _handle_hippo(platform: Platform, event: Mapping[str, Any]) -> dict[str, Any]:
    """Register the payload of HIPPO's script `updateProject.py`; return the `statusCode` and `body` that it reads.

    The script shows `body` only if the registration failed, so the remarks are logged as well.
    """
    settings = platform.settings
    try:
        _, listed = _master_list(platform)
        before = listed.find(hippo_registration.project_id(event) or "")
        earlier = msgspec.to_builtins(before) if before else {}
        registration, remarks = hippo_registration.registration_of(event, earlier)
        remarks += hippo_registration.lower_runtime(registration, settings.max_runtime)
        places = {"bucket": settings.bucket, "region": settings.region, "rootDomain": settings.root_domain}
        problems = list(hippo_registration.differing_places(event, places))
        project, duplicates = uploaded_pages.located(platform.documents, _parse(registration))
        if problems or duplicates:
            raise NotRegistered([*problems, *duplicates])
        _enter(platform, project)
    except NotRegistered as error:
        return {"statusCode": 400, "body": "\n".join([*error.problems, *hippo_registration.differing_folder(event)])}
    logger.info("what works differently from HIPPO Gym", extra={"project": project.id, "remarks": remarks})
    return {"statusCode": 200, "body": "\n".join(remarks)}


def _is_utf8(event: Mapping[str, Any]) -> bool:
    """Whether UTF-8 can hold every text of the event: none has half of a surrogate pair."""
    try:
        json.dumps(event, ensure_ascii=False).encode()
    except (ValueError, RecursionError):
        return False
    return True


def handle(platform: Platform, event: Mapping[str, Any]) -> dict[str, Any]:
    """Handle one call of the function; return `{"registered": id, "live": …, "steps": n}` or `{"problems": […]}`.

    * `{"project": …}` registers the project.
    * `{"links": {"projectId": …, "userIds": […]}}` gets `{"signatures": […]}` of signed links instead, so that
      researchers need not know the secret.
    * A payload of HIPPO's script is handled by `_handle_hippo`.
    """
    if not _is_utf8(event):
        return {"statusCode": 400, "body": NOT_UTF8, "problems": [NOT_UTF8]}
    if hippo_registration.is_payload(event):
        return _handle_hippo(platform, event)
    try:
        if "links" in event:
            return {"signatures": sign_links(platform, event["links"])}
        project = register(platform, event.get("project", event))
    except NotRegistered as error:
        return {"problems": error.problems}
    return {"registered": project.id, "live": project.live, "steps": len(project.steps)}
