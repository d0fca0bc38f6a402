"""Checks what each project's servers run: the task definition, and the image that it names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.model import warm_pool
from hippodrome.control.model.messages import CONTAINER
from hippodrome.control.model.project import MIN_RUNTIME_MARGIN, Project
from hippodrome.deployment.core import secret_parameters
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.study.definition import STOP_TIMEOUT, port

OLD = 120  # days after which an image's packages probably need updates
MAX_RUNTIME = 1440  # minutes, the most that `apply --max-runtime` takes
AGAIN = "Run `hippodrome register` in the project's folder."


def projects(context: CheckContext) -> Iterator[Finding]:
    """Check whether the servers of each live project, or of the wanted one, can start."""
    if not context.projects:
        yield look("projects", "None is live.", "`hippodrome register` in a project's folder opens it to participants.")
    for project in context.projects:
        if project.game_steps:
            yield from _project(context, project)
        else:
            yield good(f"project {project.id}", "has no game, so no servers.")


def _project(context: CheckContext, project: Project) -> Iterator[Finding]:
    check = f"project {project.id}"
    if project.max_runtime > context.platform.settings.max_runtime:
        yield look(
            check,
            f"maxRuntime is {project.max_runtime} minutes; the installation stops servers after "
            f"{context.platform.settings.max_runtime}.",
            "Give `hippodrome apply` a longer --max-runtime, or the project a shorter one.",
        )
    yield from _warm(context, project, check)
    if not project.task_definition:
        yield bad(check, "has no task definition: no server can start.", AGAIN)
        return
    try:
        task_definition = context.account.client("ecs").describe_task_definition(taskDefinition=project.task_definition)
    except ClientError as error:
        if errors.code(error) != "ClientException":
            raise
        yield bad(check, f"its task definition {project.task_definition.rpartition('/')[2]} is gone.", AGAIN)
        return
    definition = task_definition["taskDefinition"]
    wrong = [*_wrong(definition)]
    if wrong:
        yield bad(check, f"its task definition {', '.join(wrong)}.", AGAIN)
        return
    container = _container(definition)
    assert container is not None
    for name in secret_parameters.missing(context.account, context.installation.stack, project):
        yield bad(
            check,
            f"its servers need {name}, which is not stored: none can start.",
            f"Run `hippodrome secret set {name}`.",
        )
    if container.get("stopTimeout", 30) < STOP_TIMEOUT:
        yield look(
            check,
            f"a server has {container.get('stopTimeout', 30)} s to store its last recording, of {STOP_TIMEOUT}.",
            AGAIN,
        )
    if project.server_port != (wanted := port(context.installation)):
        yield look(
            check,
            f"its servers listen on port {project.server_port}, and the installation's port is {wanted}.",
            AGAIN,
        )
    yield from _image(context, check, str(container["image"]))


def _warm(context: CheckContext, project: Project, check: str) -> Iterator[Finding]:
    """Check whether warm servers have time to wait. `register` has checked it, but the installation may change."""
    settings = context.platform.settings
    needed = project.max_runtime + MIN_RUNTIME_MARGIN
    if not (project.live and project.warm_servers) or needed <= settings.max_runtime:
        return
    minutes = warm_pool.longest_wait(project, settings).total_seconds() / 60
    are_kept = minutes >= warm_pool.MIN_LONGEST_WAIT.total_seconds() / 60
    effect = f"its warm servers are replaced every {minutes:.0f} minutes" if are_kept else "no warm servers are kept"
    yield look(
        check,
        f"{effect}: the installation stops servers after {settings.max_runtime} minutes, and maxRuntime is "
        f"{project.max_runtime} of them.",
        f"Give `hippodrome apply` --max-runtime {needed}, or register the project with a shorter maxRuntime "
        "or warmServers: 0."
        if needed <= MAX_RUNTIME
        else "Register the project with a shorter maxRuntime or warmServers: 0.",
    )


def _wrong(definition: Mapping[str, Any]) -> Iterator[str]:
    """Yield the parts of the task definition that would keep a server from starting, in words."""
    if definition.get("status", "ACTIVE") != "ACTIVE":
        yield "was taken out of use"
    if _container(definition) is None:
        yield f"has no container named {CONTAINER}"
    if "FARGATE" not in definition.get("requiresCompatibilities", ["FARGATE"]):
        yield "is not for Fargate"
    if definition.get("networkMode") != "awsvpc":
        yield "has no address of its own"


def _container(definition: Mapping[str, Any]) -> Mapping[str, Any] | None:
    return next((container for container in definition["containerDefinitions"] if container["name"] == CONTAINER), None)


def _image(context: CheckContext, check: str, image: str) -> Iterator[Finding]:
    """Check whether the image is in the repository, how old it is, and whether it has known vulnerabilities."""
    repository = context.installation["Repository"]
    name, _, digest = image.partition("@")
    if not name.startswith(repository) or name[len(repository) : len(repository) + 1] not in ("", ":"):
        yield look(
            check,
            f"runs an image of another repository: {image}.",
            "`doctor` looks at images of the installation's repository only.",
        )
        return
    tag = name[len(repository) + 1 :]
    if not digest:
        yield look(check, f"names its image by a tag ({tag or 'latest'}), which may name another image later.", AGAIN)
    image_id = {"imageDigest": digest} if digest else {"imageTag": tag or "latest"}
    client, name_there = context.account.client("ecr"), repository.partition("/")[2]
    try:
        details = client.describe_images(repositoryName=name_there, imageIds=[image_id])["imageDetails"]
    except (client.exceptions.ImageNotFoundException, client.exceptions.RepositoryNotFoundException):
        details = []
    if not details:
        yield bad(check, "its image is not in the repository: pushed half-way, or deleted.", AGAIN)
        return
    detail = details[0]
    age = (context.now - detail["imagePushedAt"]).days
    size = detail.get("imageSizeInBytes", 0) / 1e6
    vulnerabilities = _vulnerabilities(client, name_there, detail["imageDigest"])
    if vulnerabilities:
        text = ", ".join(f"{count} {severity.lower()}" for severity, count in vulnerabilities.items())
        yield look(check, f"its image has known vulnerabilities: {text}.", f"{AGAIN} `--rebuild` takes newer packages.")
    if age > OLD:
        yield look(check, f"its image is {age} days old.", AGAIN)
    yield good(check, f"image of {size:,.0f} MB, {age} days old.")


def _vulnerabilities(client: Any, repository: str, digest: str) -> dict[str, int]:
    """Return the number of critical and high vulnerabilities, by severity; {} if the image was not scanned."""
    try:
        image_scan_findings = client.describe_image_scan_findings(
            repositoryName=repository, imageId={"imageDigest": digest}
        )
    except client.exceptions.ScanNotFoundException:
        return {}
    counts = image_scan_findings.get("imageScanFindings", {}).get("findingSeverityCounts", {})
    return {severity: counts[severity] for severity in ("CRITICAL", "HIGH") if counts.get(severity)}
