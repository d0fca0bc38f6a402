"""`register`: puts a study on AWS, or a new version of it, and prints the link for participants.

Image and task definition come first, since they may take minutes or fail. Then come the pages, which participants of an
open study see at once, then the registration. At last pages that the folder no longer has are removed. After an
interruption, the next run finds what is done and continues.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer

from hippodrome.console import formatting, screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws.documents import S3Documents
from hippodrome.control.config import agent_imports, parse_registration, remarks
from hippodrome.control.config.step_order import changed_pages
from hippodrome.control.model.project import DEFAULT_PORT, Project, UnreadableEntry
from hippodrome.control.model.records import from_data
from hippodrome.deployment.aws.account import Account, Installation, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options, project_folder, register_function, secret_parameters
from hippodrome.deployment.core.participants import registered_projects
from hippodrome.deployment.cost.prices import REGION, server_hour
from hippodrome.deployment.study import definition, image, pages

QR_FILES = {".svg", ".png", ".pdf"}
NO_QR = (
    "There is no QR code for a study with signedLinks: each participant has a link of their own.",
    "Leave out --qr; `hippodrome links` makes the links.",
)

Base = Annotated[
    str,
    typer.Option("--base", envvar="HIPPODROME_BASE_IMAGE", help="Another base of the image, as docker pull names it."),
]


@dataclass(frozen=True)
class RegisterRequest:
    """The options of `register`. `live`, if not None, replaces config.yml's value.

    `again`: build an image in any case.
    """

    live: bool | None = None
    again: bool = False
    docker: bool = False  # build the image by its Dockerfile, with Docker, Podman or Buildah
    yes: bool = False
    base: str = ""  # the base image, instead of the Dockerfile's own
    strict: bool = False  # stop if there is a remark


@dataclass(frozen=True)
class RegisterPlan:
    """The differences between the folder and AWS, which `register` removes."""

    study: project_folder.ProjectFolder
    before: Project | None  # the project as it is registered now
    pages: pages.Changes
    image: image.ImagePlan | None
    definition: str | None  # the ARN of the newest revision if it has the right content
    port: int = DEFAULT_PORT

    @property
    def steps(self) -> list[str]:
        """The steps that `register` would take, a line for each; empty if nothing has changed."""
        acts = [f"upload {key}" for key in self.pages.put]
        if self.image and self.image.uri is None:
            order = self.image.order
            acts.append(f"build the image {order.content} ({formatting.size(order.bundle.size)} of files)")
        if self.image and self.definition is None:
            acts.append("make a new revision of the task definition")
        if self.before is None:
            acts.append("register the project, which is new here")
        elif _differs(self.before, {**self.study.registration, **self.task(self.definition)}):
            acts.append("register the project's new version")
        return acts + [f"remove {key}" for key in self.pages.gone]

    def task(self, revision: str | None) -> dict[str, Any]:
        """Return a registration's keys for this revision: the revision, and the port on which its servers listen."""
        return {"taskDefinition": revision, "serverPort": self.port} if revision else {}


def command(
    folder: options.Folder = Path(),
    *,
    live: Annotated[
        bool | None,
        typer.Option("--live/--no-live", help="Open or close the study, whatever config.yml says.", show_default=False),
    ] = None,
    qr: Annotated[
        Path | None, typer.Option("--qr", help="Write the link as a QR code: a .svg, .png or .pdf.", show_default=False)
    ] = None,
    rebuild: Annotated[
        bool, typer.Option("--rebuild", help="Build the image anew, with the updates of what it is based on.")
    ] = False,
    docker: Annotated[
        bool, typer.Option("--docker", help="Build the image with this machine's Docker, Podman or Buildah.")
    ] = False,
    base: Base = "",
    strict: Annotated[bool, typer.Option("--strict", help="Do nothing if there is any remark on the project.")] = False,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Put the study in FOLDER on AWS, or its new version, and print the link for participants.

    Only what changed is uploaded and built. Participants see nothing of it until the image is there. With --no-live, a
    study that is open is closed at once, before anything else.
    """
    _check_qr(qr)
    if live is not False:
        study_folder = project_folder.read(folder)  # shows mistakes before credentials are needed
        if qr and study_folder.config.project.signed_links:
            raise Problem(*NO_QR)
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    request = RegisterRequest(live, rebuild, docker, yes, base, strict)
    if dry_run:
        return _tell_plan(plan(account, installation, folder, request), as_json)
    result = register(account, installation, folder, request)
    if as_json:
        screen.result_json(result)
    else:
        _tell(result)
    if qr and result["signedLinks"]:
        screen.warning(" ".join(NO_QR))
    elif qr:
        _write_qr(result["link"], qr)
    return Exit.DONE


def plan(account: Account, installation: Installation, folder: Path, request: RegisterRequest) -> RegisterPlan:
    """Compare the folder with AWS. Changes nothing. Raises `Problem` if the project cannot be registered here."""
    study_folder = project_folder.read(folder, installation)
    if request.live is not None:
        study_folder.registration["live"] = request.live
    before = _registered(account, installation, study_folder.id)
    changes = pages.compare(account, installation["Bucket"], study_folder.id, folder, study_folder.config.own_pages)
    if not study_folder.plays:
        return RegisterPlan(study_folder, before, changes, None, None)
    _must_have_secrets(account, installation, study_folder)
    trial = study_folder.registration["trial"]
    image_plan = image.plan(
        account, installation, study_folder.id, folder, again=request.again, base=request.base, trial=trial
    )
    revision = (
        None
        if image_plan.uri is None
        else definition.find(account, _definition(installation, study_folder, image_plan.uri))
    )
    return RegisterPlan(study_folder, before, changes, image_plan, revision, definition.port(installation))


def register(account: Account, installation: Installation, folder: Path, request: RegisterRequest) -> dict[str, Any]:
    """Register the study, and return what was done, as JSON data.

    Raises `Problem` if the study cannot be registered, the image cannot be built, or the answer to a question is no.
    """
    if request.live is False:
        _close(account, installation, folder)
    doing = plan(account, installation, folder, request)
    study, bucket = doing.study, installation["Bucket"]
    screen.success(f"{study.id}: {study.config.summary()}")
    remarks_found = _remarks(folder, study)
    if remarks_found and request.strict:
        raise Problem("There are remarks on the project, and --strict was given.", "Nothing was done.", remarks_found)
    for remark in remarks_found:
        screen.warning(remark)
    _confirm(account, installation, doing, request)
    image_made, revision = None, None
    if doing.image:
        image_made = image.build(doing.image, by_dockerfile=request.docker)
        screen.success(f"Image {doing.image.order.content}: {'built' if image_made.built else 'there already'}")
        wanted = _definition(installation, study, image_made.uri)
        revision = doing.definition or definition.find(account, wanted)
        is_known = revision is not None
        revision = revision or definition.register(account, installation, study.id, wanted)
        screen.success(f"Task definition {revision.rpartition('/')[2]}: {'there already' if is_known else 'new'}")
    if doing.pages.put:
        pages.upload(account, bucket, doing.pages)
    screen.success(f"Pages: {len(doing.pages.put)} uploaded, {doing.pages.same} as they were")
    registration = {**study.registration, **doing.task(revision)}
    invoke(account, installation, registration)
    screen.success("Registered: the study is " + ("open" if registration["live"] else "closed"))
    _tell_warm(registration)
    if doing.pages.gone:
        pages.remove(account, bucket, doing.pages.gone)
        screen.success(f"Pages removed that are not in the folder any more: {len(doing.pages.gone)}")
    return {
        "project": study.id,
        "live": registration["live"],
        "signedLinks": registration["signedLinks"],
        "link": None if registration["signedLinks"] else link(installation, study.id),
        "pages": {"uploaded": len(doing.pages.put), "same": doing.pages.same, "removed": len(doing.pages.gone)},
        "image": image_made.uri if image_made else None,
        "imageBuilt": image_made.built if image_made else False,
        "taskDefinition": revision,
    }


def _remarks(folder: Path, found: project_folder.ProjectFolder) -> list[str]:
    """Return remarks on a project without mistakes: on its files, the installation, and with a game its packages."""
    all_remarks = [*remarks.remarks_on(folder, found.config), *found.remarks]
    if found.plays:
        all_remarks += agent_imports.requirement_remarks(folder)
        all_remarks += agent_imports.missing(folder)
        all_remarks += agent_imports.missing_for_players(folder, found.config)
    return [str(remark) for remark in all_remarks]


def link(installation: Installation, project_id: str) -> str:
    """Make the address with which participants begin. docs/recruiting.md says what recruiters add to it."""
    return f"{installation['Site'].rstrip('/')}/next?projectId={project_id}"


def _definition(installation: Installation, found: project_folder.ProjectFolder, uri: str) -> dict[str, Any]:
    setup, secrets = found.registration["awsSetup"], secret_parameters.needed(_project(found))
    return definition.definition(installation, found.id, uri, setup["cpu"], setup["memory"], secrets=secrets)


def _project(found: project_folder.ProjectFolder) -> Project:
    """Return the project as it will be registered, without what registering adds."""
    return from_data(parse_registration(dict(found.registration)), Project)


def _must_have_secrets(account: Account, installation: Installation, found: project_folder.ProjectFolder) -> None:
    """Raise `Problem` if the study's servers need a secret that the installation lacks: none of them could start."""
    for name in secret_parameters.missing(account, installation.stack, _project(found)):
        raise Problem(
            f"The study has trial.llm, and the installation {installation.stack} has no {name}: no server could start.",
            f"Store {secret_parameters.NAMES[name]}: `hippodrome secret set {name}`. Then run this again.",
        )


def _registered(
    account: Account, installation: Installation, project_id: str, unread: list[UnreadableEntry] | None = None
) -> Project | None:
    documents = S3Documents(lambda: account.client("s3"), installation["Bucket"])
    return next((project for project in registered_projects(documents, unread) if project.id == project_id), None)


def _differs(before: Project, registration: Mapping[str, Any]) -> bool:
    """Whether the registration differs from the registered project."""
    after = from_data(parse_registration(dict(registration)), Project)
    ours = {"version": before.version, "salt": before.salt}
    return bool(msgspec.structs.replace(after, **ours) != before)


def _close(account: Account, installation: Installation, folder: Path) -> None:
    """Close an open study at once. Only the id in the folder is used, since the folder may have mistakes."""
    project_id = project_folder.id_in(folder)
    before = _registered(account, installation, project_id, []) if project_id else None
    if before is None or not before.live:
        return
    try:
        invoke(account, installation, project_folder.registration_of(before, live=False))
    except Problem as problem:  # a newer installation may refuse an old registration
        screen.warning(f"The study could not be closed at once ({problem}); it will be when it is registered anew.")
    else:
        screen.success("The study is closed: no participant can begin or go on")


def _confirm(account: Account, installation: Installation, doing: RegisterPlan, request: RegisterRequest) -> None:
    """Ask if the id belongs to a study with another name and participants, since a copied folder has the same id.

    Ask as well if the steps of an open study with participants change: the steps tell where each participant is.
    """
    before, after = doing.before, doing.study
    if before is None:
        return
    was, name = before.name or before.id, after.registration["name"]
    steps = [(step["key"], step["page"], step["variants"]) for step in after.registration["steps"]]
    had = [(step.key, step.page, step.variants) for step in before.steps]
    under_way = steps != had and before.live and after.registration["live"]
    if was == name and not under_way:
        return
    answer = account.client("s3").list_objects_v2(Bucket=installation["Bucket"], Prefix=f"{after.id}/users/", MaxKeys=1)
    if not answer.get("KeyCount"):
        return
    if was != name:
        question = (
            f"The study {after.id} has participants and is called {was}, and this one {name}. "
            "Is it the same study? (If not, no: give this one a project.id of its own.)"
        )
        screen.confirm(question, request.yes)
    if under_way:
        changed = changed_pages(*({key: page for key, page, _ in step} for step in (had, steps)))
        which = f": {changed}" if changed else ""
        question = f"The study is open and has participants, and its steps change for them too{which}. Go on?"
        screen.confirm(question, request.yes)


def invoke(account: Account, installation: Installation, registration: Mapping[str, Any]) -> None:
    """Register the project by the installation's function. Raises `Problem` with the mistakes that it finds."""
    answer = register_function.ask(account, installation, {"project": registration})
    if "registered" not in answer:
        problems = [str(problem) for problem in answer.get("problems") or []]
        raise Problem("The installation did not take the project.", _advice(problems), problems)


def _advice(problems: Sequence[str]) -> str:
    """Advise on these problems. A function that does not know a key is older than this version."""
    if not problems:
        return "Bring it up to date with `hippodrome deploy`."
    if any("unknown key" in problem for problem in problems):
        return (
            "The installation is older than this study: bring it up to date with `hippodrome deploy`, "
            "or ask your administrator to. Then run this again."
        )
    return "Correct this and run it again."


def _tell_warm(registration: Mapping[str, Any]) -> None:
    """Warn about the cost of warm servers from now on, even without participants."""
    number, setup = registration["warmServers"], registration["awsSetup"]
    if not number or not registration["live"]:
        return
    hours = (server_hour(setup["cpu"], setup["memory"], spot=spot).likely for spot in (True, False))
    day, most = (hour * number * 24 for hour in hours)
    screen.warning(
        f"{formatting.count(number, 'server')} will be kept warm while the study is open: about ${day:,.2f} a day on "
        f"Spot, ${most:,.2f} on demand (list prices of {REGION}). `register --no-live` ends it."
    )


def _tell_plan(doing: RegisterPlan, as_json: bool) -> int:
    steps = doing.steps
    if as_json:
        screen.result_json({"project": doing.study.id, "steps": steps})
    elif steps:
        screen.table(["to do"], [[step] for step in steps])
    else:
        screen.result("Nothing to do: all is as it should be.")
    return Exit.CHANGES if steps else Exit.DONE


def _tell(result: Mapping[str, Any]) -> None:
    screen.result("")
    if result["signedLinks"]:
        _tell_signed(result["project"])
    else:
        _tell_link(result["link"])
    if not result["live"]:
        which = "these links open" if result["signedLinks"] else "the link opens"
        screen.result(f"The study is closed: {which} it after `register --live`.")


def _tell_signed(project_id: str) -> None:
    """Print how to make signed links. An address without a signature is refused."""
    command = f"hippodrome links {project_id}"
    screen.result("Links are signed: each participant needs one of their own.")
    screen.result(f"For new participants:  {command} --new 50")
    screen.result(f"With ids of your own:  {command} --ids ids.txt")


def _tell_link(address: str) -> None:
    screen.result(address)
    screen.result("")
    if sys.stdout.isatty():
        _qr(address).terminal(out=sys.stdout, compact=True)
        screen.result("")
    screen.result(f"With ids of your own: {address}&userId=ID")
    screen.result(f"For Prolific:         {address}&PROLIFIC_PID={{{{%PROLIFIC_PID%}}}}")


def _qr(address: str) -> Any:
    import segno  # noqa: PLC0415 - the other commands need no QR codes

    return segno.make(address, micro=False)


def _check_qr(file: Path | None) -> None:
    if file is None:
        return
    if file.suffix.lower() not in QR_FILES:
        raise Problem(f"A QR code cannot be written as {file.name}.", "Name a file that ends in .svg, .png or .pdf.")
    if not file.absolute().parent.is_dir():
        raise Problem(f"There is no folder {file.parent}.", "Make it, or name another file for the QR code.")


def _write_qr(address: str, file: Path) -> None:
    try:
        _qr(address).save(str(file), scale=8)
    except OSError as error:
        raise Problem(
            f"The QR code could not be written to {file}: {error.strerror}.",
            "The study is registered all the same. Run the same command again with another file.",
        ) from None
    screen.success(f"QR code in {file}")
