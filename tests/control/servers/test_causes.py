"""The causes for which servers fail are read from AWS's messages."""

from __future__ import annotations

import pytest

from hippodrome.control.model.server import TaskStopped
from hippodrome.control.ports import NoCapacity, Refused
from hippodrome.control.servers import causes
from hippodrome.control.servers.causes import Cause, FailureCategory
from hippodrome.protocol import exits

EXITED = "EssentialContainerExited"
FAILED = "TaskFailedToStart"


@pytest.mark.parametrize(
    ("code", "words", "cause"),
    [
        (
            FAILED,
            "CannotPullContainerError: pull image manifest has been retried 5 time(s): failed to resolve",
            "image",
        ),
        (
            FAILED,
            "CannotPullContainerError: The task can\u2019t pull the image. Check that the role has permission",
            "image",
        ),
        (FAILED, "CannotPullContainerError: ref pull has been retried 1 time(s): failed to unpack image", "image"),
        (FAILED, "CannotPullECRContainerError: AccessDeniedException", "image"),
        (FAILED, "CannotPullImageManifestError: Error response from daemon: manifest unknown", "image"),
        (
            FAILED,
            "ResourceInitializationError: unable to pull secrets or registry auth: connection issue",
            "initialisation",
        ),
        (FAILED, "ResourceInitializationError: failed to validate logger args: : signal: killed", "initialisation"),
        (
            FAILED,
            "CannotStartContainerError: Error response from daemon: failed to initialize logging driver: failed to create "
            "Cloudwatch log stream: ResourceNotFoundException: The specified log group does not exist.",
            "initialisation",
        ),
        (
            FAILED,
            "CannotStartContainerError: ResourceInitializationError: failed to create new container runtime task: OCI "
            'runtime create failed: exec: "python": executable file not found in $PATH',
            "cannot begin",
        ),
        (EXITED, "Essential container in task exited exec /usr/local/bin/python: exec format error", "cannot begin"),
        (FAILED, "CannotStartContainerError: failed to get container status", "cannot begin"),
        (FAILED, "Timeout waiting for network interface provisioning to complete.", "machine"),
        (
            FAILED,
            "ContainerRuntimeTimeoutError: Could not transition to running; timed out after waiting 3m0s",
            "machine",
        ),
        (
            FAILED,
            "Unexpected EC2 error while attempting to Create Network Interface with public IP assignment enabled in "
            "subnet 'subnet-1': InsufficientFreeAddressesInSubnet",
            "quota",
        ),
        (FAILED, "Capacity is unavailable at this time. Please try again later", "no capacity"),
        ("SpotInterruption", "Your Spot Task was interrupted.", "spot"),
        ("TerminationNotice", "Your Spot Task was interrupted.", "spot"),
        ("InfrastructureHealth", "Task stopped because of a problem of the infrastructure", "machine"),
        (EXITED, "OutOfMemoryError: Container killed due to memory usage", "out of memory"),
        (EXITED, "Essential container in task exited OutOfMemoryError: container killed", "out of memory"),
        (EXITED, "Essential container in task exited: the process was killed", "killed"),
        (None, "", "unknown"),
        ("AWordOfNextYear", "something new", "unknown"),
    ],
)
def test_the_stopped_reason_of_a_task_gives_the_cause(code: str | None, words: str, cause: str) -> None:
    assert causes.cause_of_task(TaskStopped(code, None, words), was_ready=False) == cause


@pytest.mark.parametrize(
    ("exit_code", "was_ready", "cause"),
    [
        (1, False, Cause.ENDED_AT_ONCE),
        (1, True, Cause.CRASHED),
        (139, False, Cause.ENDED_AT_ONCE),
        (exits.NO_AGENT, True, Cause.ENDED_AT_ONCE),
        (exits.LATE_AGENT, True, Cause.NEVER_READY),
        (exits.NO_PORT, False, Cause.NO_PORT),
        (137, False, Cause.OUT_OF_MEMORY),
        (137, True, Cause.OUT_OF_MEMORY),
        (None, True, Cause.UNKNOWN),
    ],
)
def test_the_exit_code_gives_the_cause_if_the_program_ended(
    exit_code: int | None, was_ready: bool, cause: Cause
) -> None:
    stopped = TaskStopped(EXITED, exit_code, "Essential container in task exited")
    assert causes.cause_of_task(stopped, was_ready=was_ready) is cause


def test_a_server_that_spot_killed_after_its_warning_has_the_cause_spot() -> None:
    assert causes.cause_of_task(TaskStopped("SpotInterruption", 137, ""), was_ready=True) is Cause.SPOT


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (NoCapacity("Capacity is unavailable at this time. Please try again later"), Cause.CAPACITY),
        (NoCapacity("RunTask started no task and gave no reason"), Cause.CAPACITY),
        (NoCapacity("You've reached the limit on the number of vCPUs you can run concurrently"), Cause.QUOTA),
        (NoCapacity("The requested CPU configuration is above your limit"), Cause.QUOTA),
        (NoCapacity("The requested MEMORY configuration is above your limit."), Cause.QUOTA),
        (Refused("ClientException: TaskDefinition not found."), Cause.DEFINITION),
        (Refused("InvalidParameterException: TaskDefinition is inactive"), Cause.DEFINITION),
        (Refused("ClientException: No Fargate configuration exists for given values."), Cause.SIZE),
        (Refused("AccessDeniedException: User: … is not authorized to perform: iam:PassRole"), Cause.PERMISSION),
        (Refused("BlockedException: Your account has been blocked and can't send requests."), Cause.PERMISSION),
        (Refused("UnsupportedFeatureException: not in this region"), Cause.REFUSED),
    ],
)
def test_a_refusal_of_run_task_gives_the_cause(error: NoCapacity | Refused, cause: Cause) -> None:
    assert causes.cause_of_refusal(error) is cause


def test_a_blocked_account_is_told_what_helps() -> None:
    blocked = causes.cause_of_refusal(Refused("BlockedException: Your account has been blocked."))
    assert "AWS does not allow the installation to run servers." in blocked.sentence
    assert "start the smallest EC2 instance" in blocked.sentence


def test_the_values_of_causes_stay_as_they_are_in_stored_records() -> None:
    assert [cause.value for cause in Cause] == [
        "image",
        "initialisation",
        "cannot begin",
        "ended at once",
        "never ready",
        "no port",
        "no certificate",
        "crashed",
        "out of memory",
        "killed",
        "no task definition",
        "no permission",
        "impossible size",
        "quota",
        "refused",
        "no capacity",
        "spot",
        "machine",
        "vanished",
        "unknown",
    ]


def test_a_cause_of_a_later_version_is_unknown() -> None:
    assert causes.parse_cause("image") is Cause.IMAGE
    assert causes.parse_cause("") is causes.parse_cause("of a later version") is None


def test_only_these_causes_are_the_responsibility_of_aws() -> None:
    aws = {cause for cause in Cause if cause.category is FailureCategory.AWS}
    assert aws == {Cause.CAPACITY, Cause.SPOT, Cause.MACHINE, Cause.VANISHED, Cause.UNKNOWN}
