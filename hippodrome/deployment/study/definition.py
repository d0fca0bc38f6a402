"""A project's task definition in ECS: the image of its servers, their size, and their rights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.model.messages import CONTAINER
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.protocol import environment

STOP_TIMEOUT = 120  # seconds from SIGTERM to SIGKILL, for a server's last recording; Fargate allows no more
SCRATCH = "/scratch"  # the only folder into which a trial may write (infra/Dockerfile)
USER = "10001:10001"
PRIVILEGED = 1024  # only a privileged user may listen on lower ports
LOWEST_PORT = 80  # on which the trial may listen: the certificate authority asks there (control/certificates/)


def port(installation: Installation) -> int:
    """Return the port on which the servers of a study will listen if it is registered now."""
    return int(installation["ServerPort"])


def definition(
    installation: Installation, project_id: str, image: str, cpu: float, memory: float, *, secrets: Sequence[str] = ()
) -> dict[str, Any]:
    """Make the task definition, as RegisterTaskDefinition takes it. `cpu` in vCPU, `memory` in GB.

    `secrets` are the names of the secrets that the servers need (`deployment/core/secret_parameters.py`).

    The container's root is read-only. Fargate has no tmpfs; it makes a volume of the Dockerfile's VOLUME and gives it
    the owner that the path has in the image (ECS Developer Guide, "Use bind mounts with Amazon ECS"), so that a user
    who is not root can write there. The definition holds no secret: RunTask gives a server its own values, and Fargate
    reads those of the installation's studies in their parameters when it starts the container. There is no task role,
    so the code in the container has no rights on AWS (hippodrome/control/servers/signing.py).

    A user without any capability may listen below 1024 if the kernel's parameter says so for the task's own network
    namespace. Fargate supports every `net.*` parameter from platform version 1.4.0 on (ECS API Reference,
    SystemControl, read November 2026), and others use this one there (statista-oss/routing-proxy). File capabilities
    would have no effect, since all capabilities are dropped.
    """
    container = {
        "name": CONTAINER,
        "image": image,
        "essential": True,
        "user": USER,
        "readonlyRootFilesystem": True,
        "portMappings": [{"containerPort": port(installation), "protocol": "tcp"}],
        "mountPoints": [{"sourceVolume": "scratch", "containerPath": SCRATCH, "readOnly": False}],
        "linuxParameters": {"initProcessEnabled": True, "capabilities": {"drop": ["ALL"]}},
        "stopTimeout": STOP_TIMEOUT,
        "environment": [{"name": environment.STOP_SECONDS, "value": str(STOP_TIMEOUT)}],
        "logConfiguration": {
            "logDriver": "awslogs",
            "options": {
                "awslogs-group": installation["TrialLogGroup"],
                "awslogs-region": installation.region,
                "awslogs-stream-prefix": project_id,
                "mode": "non-blocking",  # a game must not wait for its log
                "max-buffer-size": "4m",
            },
        },
    }
    if not installation.has_domain or port(installation) < PRIVILEGED:
        container["systemControls"] = [{"namespace": "net.ipv4.ip_unprivileged_port_start", "value": str(LOWEST_PORT)}]
    if secrets:
        container["secrets"] = [{"name": name, "valueFrom": _parameter(installation, name)} for name in secrets]
    return {
        "family": resource_names.family(installation.stack, project_id),
        "networkMode": "awsvpc",
        "requiresCompatibilities": ["FARGATE"],
        "runtimePlatform": {"cpuArchitecture": "X86_64", "operatingSystemFamily": "LINUX"},
        "cpu": str(round(cpu * 1024)),
        "memory": str(round(memory * 1024)),
        "executionRoleArn": installation["TaskExecutionRole"],
        "volumes": [{"name": "scratch"}],
        "containerDefinitions": [container],
    }


def find(account: Account, definition: Mapping[str, Any]) -> str | None:
    """Find the family's newest revision if it is active and has this content. Return its ARN, or None."""
    try:
        task_definition = account.client("ecs").describe_task_definition(taskDefinition=definition["family"])[
            "taskDefinition"
        ]
    except ClientError as error:
        if errors.code(error) == "ClientException":  # there is no such family
            return None
        raise
    if task_definition.get("status", "ACTIVE") != "ACTIVE":
        return None
    same = _contains(task_definition, definition) and _secrets(task_definition) == _secrets(definition)
    return str(task_definition["taskDefinitionArn"]) if same else None


def register(account: Account, installation: Installation, project_id: str, definition: Mapping[str, Any]) -> str:
    """Register a new revision, and return its ARN."""
    tags = {TAG: installation.stack, "hippodrome:project": project_id}
    answer = account.client("ecs").register_task_definition(
        **definition, tags=[{"key": key, "value": value} for key, value in tags.items()]
    )
    return str(answer["taskDefinition"]["taskDefinitionArn"])


def _parameter(installation: Installation, secret: str) -> str:
    """Return the ARN of the parameter that holds the secret, which lies in the installation's account."""
    _, partition, _, _, account, _ = installation["TaskExecutionRole"].split(":", 5)
    name = resource_names.secret(installation.stack, secret)
    return f"arn:{partition}:ssm:{installation.region}:{account}:parameter{name}"


def _secrets(found: Mapping[str, Any]) -> list[str]:
    """Return the names of the secrets that the containers get. A study without a model must not keep its key."""
    return [secret["name"] for container in found["containerDefinitions"] for secret in container.get("secrets") or ()]


def _contains(found: Any, pattern: Any) -> bool:
    """Whether `found` has all values of `pattern`. ECS adds values that were left out, such as host ports."""
    if isinstance(pattern, Mapping):
        return isinstance(found, Mapping) and all(_contains(found.get(key), value) for key, value in pattern.items())
    if isinstance(pattern, Sequence) and not isinstance(pattern, str):
        return (
            isinstance(found, Sequence)
            and len(found) == len(pattern)
            and all(_contains(part, other) for part, other in zip(found, pattern, strict=True))
        )
    return bool(found == pattern)
