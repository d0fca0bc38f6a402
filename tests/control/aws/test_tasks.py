"""What `EcsTasks` asks of ECS and EC2, and what it makes of their answers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from botocore.exceptions import ClientError

from hippodrome.control.aws.tasks import client_token
from hippodrome.control.ports import NoCapacity, Refused, TaskRequest
from testing.moto_world import MotoWorld

NAME = "s" + "a" * 20 + "-1"
REQUEST = TaskRequest(NAME, "hippodrome", "hippodrome", 0.25, 0.5, {"TOKEN": "secret", "USER_ID": "P1"})


def test_run_task_gets_the_parameters_of_the_request(moto_world: MotoWorld) -> None:
    moto_world.platform.tasks.run(REQUEST)
    [call] = moto_world.calls
    assert call.action == "ecs:RunTask"
    environment = {
        item["name"]: item["value"] for item in call.params["overrides"]["containerOverrides"][0]["environment"]
    }
    assert environment == {
        "TOKEN": "secret",
        "USER_ID": "P1",
        "STORE": "https://study.example.org/sign",
        "HOST": "0.0.0.0",
        "PORT": "5000",
    }
    assert call.params["overrides"]["containerOverrides"][0]["name"] == "trial"
    assert (call.params["overrides"]["cpu"], call.params["overrides"]["memory"]) == ("256", "512")
    assert call.params["capacityProviderStrategy"] == [{"capacityProvider": "FARGATE_SPOT", "weight": 1}]
    assert "launchType" not in call.params
    network = call.params["networkConfiguration"]["awsvpcConfiguration"]
    assert network["subnets"] == moto_world.env["SUBNET"].split(",")
    assert len(network["subnets"]) == 2
    assert network["assignPublicIp"] == "ENABLED"
    assert call.params["startedBy"] == NAME
    assert call.params["propagateTags"] == "TASK_DEFINITION"
    assert len(call.params["clientToken"]) == 64


def test_a_server_gets_the_port_of_its_request(moto_world: MotoWorld) -> None:
    moto_world.platform.tasks.run(replace(REQUEST, port=443))
    told = moto_world.calls[0].params["overrides"]["containerOverrides"][0]["environment"]
    assert {"name": "PORT", "value": "443"} in told


def test_a_request_on_demand_runs_another_task_than_one_on_spot(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    assert tasks.run(REQUEST) != tasks.run(replace(REQUEST, spot=False))
    assert moto_world.calls[1].params["capacityProviderStrategy"] == [{"capacityProvider": "FARGATE", "weight": 1}]
    assert client_token(REQUEST) != client_token(replace(REQUEST, spot=False))
    assert client_token(REQUEST) != client_token(replace(REQUEST, name=f"{NAME}0"))


def test_a_name_that_is_used_again_after_an_erasure_runs_another_task(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    first = tasks.run(replace(REQUEST, nonce="before"))
    assert tasks.run(replace(REQUEST, nonce="before")) == first
    assert tasks.run(replace(REQUEST, nonce="after")) != first


def test_the_repr_of_a_request_does_not_show_its_environment() -> None:
    assert "secret" not in repr(REQUEST)


def test_overrides_that_are_too_long_for_ecs_are_refused_without_a_call(moto_world: MotoWorld) -> None:
    with pytest.raises(Refused, match=r"takes \d+ characters, and ECS allows 8192"):
        moto_world.platform.tasks.run(replace(REQUEST, environment={"TRIAL": "x" * 8000}))
    assert moto_world.calls == []


FULL = "Capacity is unavailable at this time. Please try again later or in a different availability zone"
VCPUS = "You've reached the limit on the number of vCPUs you can run concurrently"


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        (FULL, NoCapacity),
        ("RESOURCE:ENI", NoCapacity),
        (VCPUS, NoCapacity),
        ("The requested CPU configuration is above your limit", NoCapacity),
        ("The requested MEMORY configuration is above your limit.", NoCapacity),
        ("Internal error.", NoCapacity),
        ("Rate exceeded", NoCapacity),
        ("MISSING", Refused),
        ("ATTRIBUTE", Refused),
    ],
)
def test_failures_of_run_task(moto_world: MotoWorld, reason: str, kind: type[Exception]) -> None:
    moto_world.answer("ecs:RunTask", {"tasks": [], "failures": [{"reason": reason}]})
    with pytest.raises(kind, match=reason[:20]):
        moto_world.platform.tasks.run(REQUEST)


def test_an_empty_answer_of_run_task_means_no_capacity(moto_world: MotoWorld) -> None:
    moto_world.answer("ecs:RunTask", {"tasks": [], "failures": []})
    with pytest.raises(NoCapacity):
        moto_world.platform.tasks.run(REQUEST)


@pytest.mark.parametrize(
    ("code", "message", "kind"),
    [
        ("ClientException", VCPUS, NoCapacity),
        ("ClientException", "You've reached the limit on the number of tasks you can run concurrently", NoCapacity),
        ("ClientException", FULL, NoCapacity),
        ("ClientException", "Unable to describe task definition.", Refused),
        ("ClientException", "The requested CPU configuration is above your limit", NoCapacity),
        ("InvalidParameterException", "No Fargate configuration exists for given values.", Refused),
        ("ClusterNotFoundException", "Cluster not found.", Refused),
        ("AccessDeniedException", "User is not authorized to perform: iam:PassRole", Refused),
        ("BlockedException", "Your AWS account was blocked.", Refused),
        ("ThrottlingException", "Rate exceeded", ClientError),
        ("ServerException", "Service Unavailable", ClientError),
        ("ExpiredTokenException", "The security token included in the request is expired", ClientError),
        (
            "InvalidParameterException",
            "Error retrieving security group information for [sg-1]: Request limit exceeded. "
            "(ErrorCode: RequestLimitExceeded)",
            ClientError,
        ),
        (
            "InvalidParameterException",
            "Unable to assume the service linked role. Please verify that the ECS service linked role exists.",
            ClientError,
        ),
    ],
)
def test_errors_of_run_task(moto_world: MotoWorld, code: str, message: str, kind: type[Exception]) -> None:
    moto_world.fail("ecs:RunTask", code, message)
    with pytest.raises(kind) as caught:
        moto_world.platform.tasks.run(REQUEST)
    assert type(caught.value) is kind or kind is ClientError
    assert message in str(caught.value)


def test_a_participants_own_cluster_that_is_not_ready_raises_an_error_that_is_tried_again(
    moto_world: MotoWorld,
) -> None:
    own = replace(REQUEST, cluster=NAME)
    with pytest.raises(ClientError, match="ClusterNotFound"):
        moto_world.platform.tasks.run(own)
    moto_world.fail("ecs:RunTask", "InvalidParameterException", "The specified capacity provider was not found")
    with pytest.raises(ClientError):
        moto_world.platform.tasks.run(own)
    moto_world.fail("ecs:RunTask", "InvalidParameterException", "The specified capacity provider was not found")
    with pytest.raises(Refused):
        moto_world.platform.tasks.run(REQUEST)


def test_a_participants_own_cluster_has_no_container_insights(moto_world: MotoWorld) -> None:
    """Container Insights costs per metric, and leaves a log group of the cluster's name behind."""
    moto_world.platform.tasks.create_cluster(NAME)
    [call] = moto_world.calls
    assert call.params["settings"] == [{"name": "containerInsights", "value": "disabled"}]


@pytest.mark.parametrize(
    ("code", "message", "fine"),
    [
        ("InvalidParameterException", "The referenced task was not found.", True),
        ("InvalidParameterException", "The referenced cluster was inactive.", True),
        ("ClusterNotFoundException", "Cluster not found.", True),
        ("InvalidParameterException", "Task Identifier is invalid", False),
        ("AccessDeniedException", "not authorized", False),
        ("ThrottlingException", "Rate exceeded", False),
    ],
)
def test_errors_of_stop_task(moto_world: MotoWorld, code: str, message: str, fine: bool) -> None:
    moto_world.fail("ecs:StopTask", code, message)
    if fine:
        moto_world.platform.tasks.stop("task", "hippodrome", "hippodrome: why")
    else:
        with pytest.raises(ClientError, match=code):
            moto_world.platform.tasks.stop("task", "hippodrome", "hippodrome: why")


def test_one_call_for_all_addresses_and_one_more_if_some_are_gone(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    interfaces = [interface_of(moto_world, tasks.run(replace(REQUEST, name=NAME[:-1] + str(n)))) for n in range(1, 4)]
    with moto_world.recording() as calls:
        assert len(tasks.addresses(interfaces)) == 3
    assert [call.operation for call in calls] == ["DescribeNetworkInterfaces"]
    gone = ["eni-00000000000000001", "eni-00000000000000002"]
    moto_world.fail(
        "ec2:DescribeNetworkInterfaces",
        "InvalidNetworkInterfaceID.NotFound",
        f"The networkInterface IDs '{', '.join(gone)}' do not exist",
    )
    with moto_world.recording() as calls:
        assert set(tasks.addresses([*interfaces, *gone])) == set(interfaces)
    assert len(calls) == 2


def test_an_interface_without_a_public_address_is_left_out(moto_world: MotoWorld) -> None:
    task = moto_world.platform.tasks.run(REQUEST)
    event = moto_world.task_event(task, "PENDING")
    assert moto_world.platform.tasks.addresses([_id(event)]) == {}


def test_an_error_that_names_no_requested_interface_is_raised(moto_world: MotoWorld) -> None:
    moto_world.fail("ec2:DescribeNetworkInterfaces", "InvalidNetworkInterfaceID.NotFound", "something else")
    with pytest.raises(ClientError):
        moto_world.platform.tasks.addresses(["eni-1"])


def test_tasks_and_clusters_of_others_are_not_listed(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    tasks.run(replace(REQUEST, name="ecs-svc/1234567890"))
    moto_world.client("ecs").create_cluster(clusterName="somebody-elses")
    moto_world.client("ecs").create_cluster(clusterName="student-1")
    assert list(tasks.list()) == []
    assert list(tasks.clusters()) == []


def test_tasks_are_counted_with_list_calls_only(moto_world: MotoWorld) -> None:
    """`status` counts them with a researcher's rights, which allow no more than lists."""
    tasks = moto_world.platform.tasks
    tasks.create_cluster(NAME)
    for request in (REQUEST, replace(REQUEST, name=f"{NAME[:-1]}2"), replace(REQUEST, cluster=NAME)):
        tasks.run(request)
    moto_world.client("ecs").create_cluster(clusterName="somebody-elses")
    moto_world.client("ecs").stop_task(cluster="hippodrome", task=tasks.run(replace(REQUEST, name=f"{NAME[:-1]}3")))
    with moto_world.recording() as calls:
        assert tasks.count() == 3
    assert {call.action for call in calls} == {"ecs:ListClusters", "ecs:ListTasks"}


def test_a_cluster_that_is_deleted_during_the_count_counts_no_tasks(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    tasks.run(REQUEST)
    tasks.create_cluster(NAME)
    moto_world.refuse(
        "ecs:ListTasks", lambda params: params["cluster"] == NAME, "ClusterNotFoundException", "it was there"
    )
    assert tasks.count() == 1
    moto_world.fail("ecs:ListTasks", "AccessDeniedException")
    with pytest.raises(ClientError):
        tasks.count()


def test_a_cluster_that_is_deleted_during_the_listing_has_no_tasks(moto_world: MotoWorld) -> None:
    tasks = moto_world.platform.tasks
    task = tasks.run(REQUEST)
    tasks.create_cluster(NAME)
    listing = tasks.list()
    assert next(listing).task == task
    moto_world.fail("ecs:ListTasks", "ClusterNotFoundException")
    assert list(listing) == []


def interface_of(world: MotoWorld, task: str) -> str:
    return _id(world.task_event(task, "RUNNING"))


def _id(event: Any) -> str:
    details = event["detail"]["attachments"][0]["details"]
    return str(next(item["value"] for item in details if item["name"] == "networkInterfaceId"))
