"""Checks what each project's servers run: the task definition that `register` made, and the image that it names."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.model.project import MIN_RUNTIME_MARGIN, Project
from hippodrome.deployment.core import secret_parameters
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.study.definition import port

OLD = 120  # days after which an image's packages probably need updates
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
    check, allowed = f"project {project.id}", context.platform.settings.max_runtime
    warm = bool(project.live and project.warm_servers)
    needed = project.max_runtime + (MIN_RUNTIME_MARGIN if warm else 0)
    if needed > allowed:  # `register` has checked it, but the installation may have changed
        waits = ", and its warm servers need an hour more to wait for participants" if warm else ""
        yield look(
            check,
            f"maxRuntime is {project.max_runtime} minutes{waits}; the installation stops servers after {allowed}.",
            f"Give `hippodrome deploy --no-study` --max-runtime {needed}, or register the project with a shorter "
            f"maxRuntime{' or warmServers: 0' if warm else ''}.",
        )
    if not project.task_definition:
        yield bad(check, "has no task definition: no server can start.", AGAIN)
        return
    ecs = context.account.client("ecs")
    try:
        definition = ecs.describe_task_definition(taskDefinition=project.task_definition)["taskDefinition"]
    except ClientError as error:
        if errors.code(error) != "ClientException":
            raise
        definition = {}
    if definition.get("status") != "ACTIVE":
        name = project.task_definition.rpartition("/")[2]
        yield bad(check, f"its task definition {name} is gone: no server can start.", AGAIN)
        return
    for name in secret_parameters.missing(context.account, context.installation.stack, project):
        yield bad(
            check,
            f"its servers need {name}, which is not stored: none can start.",
            f"Run `hippodrome secret set {name}`.",
        )
    if project.server_port != (wanted := port(context.installation)):
        yield look(
            check, f"its servers listen on port {project.server_port}, and the installation's port is {wanted}.", AGAIN
        )
    yield from _image(context, check, str(definition["containerDefinitions"][0]["image"]))


def _image(context: CheckContext, check: str, image: str) -> Iterator[Finding]:
    """Check whether the image is in the repository, how old it is, and whether it has known vulnerabilities."""
    name, _, digest = image.partition("@")
    repository, client = name.partition("/")[2], context.account.client("ecr")
    try:
        details = client.describe_images(repositoryName=repository, imageIds=[{"imageDigest": digest}])["imageDetails"]
    except (client.exceptions.ImageNotFoundException, client.exceptions.RepositoryNotFoundException):
        details = []
    if not details:
        yield bad(check, "its image is not in the repository: pushed half-way, or deleted.", AGAIN)
        return
    age = (context.now - details[0]["imagePushedAt"]).days
    if vulnerabilities := _vulnerabilities(client, repository, digest):
        text = f"its image has known vulnerabilities: {vulnerabilities}."
        yield look(check, text, f"{AGAIN} `--rebuild` takes newer packages.")
    if age > OLD:
        yield look(check, f"its image is {age} days old.", AGAIN)
    yield good(check, f"image of {details[0].get('imageSizeInBytes', 0) / 1e6:,.0f} MB, {age} days old.")


def _vulnerabilities(client: Any, repository: str, digest: str) -> str:
    """Count the critical and high vulnerabilities, in words; "" if there is none, or the image was not scanned."""
    try:
        scan = client.describe_image_scan_findings(repositoryName=repository, imageId={"imageDigest": digest})
    except client.exceptions.ScanNotFoundException:
        return ""
    counts = scan.get("imageScanFindings", {}).get("findingSeverityCounts", {})
    return ", ".join(f"{counts[kind]} {kind.lower()}" for kind in ("CRITICAL", "HIGH") if counts.get(kind))
