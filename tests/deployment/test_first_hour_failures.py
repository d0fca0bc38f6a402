"""The program reports the failures of docs/first-hour.md in the page's words: each is caused here, or its test is named."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.deployment.aws import quotas
from hippodrome.deployment.core import project_folder
from hippodrome.deployment.lifecycle.apply import ApplyRequest, apply
from hippodrome.deployment.stack.settings import StackSettings
from tests import first_hour
from tests.deployment.fake_cloudformation import Step
from tests.deployment.registering import write_study
from tests.deployment.stack_world import DOMAIN, World

DELETED: list[Step] = [("DELETE_IN_PROGRESS", []), ("DELETE_COMPLETE", [])]


def full_of_networks(world: World) -> None:
    world.limits.quotas[quotas.VPCS] = len(world.account.client("ec2").describe_vpcs()["Vpcs"])


def half_destroyed(world: World) -> None:
    world.account.client("logs").create_log_group(logGroupName="/hippodrome/hippodrome/sweep")


def half_deleted(world: World) -> None:
    world.stand("DELETE_FAILED")


def never_alive(world: World) -> None:
    world.stand("ROLLBACK_COMPLETE")
    world.cloud.operations = [list(DELETED)]


def under_way(world: World) -> None:
    world.stand("UPDATE_IN_PROGRESS")
    world.cloud.script = [("UPDATE_IN_PROGRESS", []), ("UPDATE_COMPLETE", [])]


def failed_update(world: World) -> None:
    world.stand("UPDATE_FAILED")
    world.cloud.operations = [[("UPDATE_ROLLBACK_IN_PROGRESS", []), ("UPDATE_ROLLBACK_COMPLETE", [])]]


def stuck_update(world: World) -> None:
    world.stand("UPDATE_ROLLBACK_FAILED")
    world.cloud.operations = [[("UPDATE_ROLLBACK_IN_PROGRESS", []), ("UPDATE_ROLLBACK_COMPLETE", [])]]


def refused(world: World) -> None:
    vpc = ("Vpc", "AWS::EC2::VPC", "CREATE_FAILED", "The maximum number of VPCs has been reached.")
    world.cloud.operations = [
        [("CREATE_IN_PROGRESS", []), ("ROLLBACK_IN_PROGRESS", [vpc]), ("ROLLBACK_COMPLETE", [])],
    ]


STOPS: dict[str, Callable[[World], None]] = {
    "VPCs: There are … VPCs in …, and this account may have no more.": full_of_networks,
    "left over: An earlier installation … has left …": half_destroyed,
    "The stack … is half deleted (DELETE_FAILED).": half_deleted,
    "The stack … could not be made …": refused,
}
GOES_ON: dict[str, Callable[[World], None]] = {
    "The stack … is in …: its making failed, and nothing of it works.": never_alive,
    "The stack … is in …: waiting for that first.": under_way,
    "An update of … failed and was left as it is …: back to before.": failed_update,
    "An earlier update of … could not be taken back: CloudFormation tries again.": stuck_update,
}


@pytest.fixture
def game(tmp_path: Path) -> project_folder.ProjectFolder:
    return project_folder.read(write_study(tmp_path / "study"))


def deploying(world: World, game: project_folder.ProjectFolder, capsys: pytest.CaptureFixture[str]) -> tuple[bool, str]:
    """Run deploy. Returns whether it succeeded, and what it printed."""
    try:
        apply(world.account, "hippodrome", StackSettings(domain=DOMAIN), ApplyRequest(game))
    except Problem as problem:
        screen.show_problem(problem)
        return False, capsys.readouterr().err
    return True, capsys.readouterr().err


def pattern(message: str) -> str:
    assert message in first_hour.failures(), "on the page"
    return ".*".join(map(re.escape, message.split(first_hour.GAP)))


@pytest.mark.parametrize("message", STOPS)
def test_failures_that_stop_deploy_are_reported_with_a_remedy(
    world: World, game: project_folder.ProjectFolder, capsys: pytest.CaptureFixture[str], message: str
) -> None:
    STOPS[message](world)
    done, said = deploying(world, game, capsys)
    assert not done
    assert re.search(rf"✗ {pattern(message)}.*\n(  .*\n)*\s*→ ", said), said


@pytest.mark.parametrize("message", GOES_ON)
def test_failures_that_pass_are_reported_and_deploy_goes_on(
    world: World, game: project_folder.ProjectFolder, capsys: pytest.CaptureFixture[str], message: str
) -> None:
    GOES_ON[message](world)
    done, said = deploying(world, game, capsys)
    assert re.search(pattern(message), said), said
    assert done


def test_without_failures_none_of_these_messages_is_printed(
    world: World, game: project_folder.ProjectFolder, capsys: pytest.CaptureFixture[str]
) -> None:
    done, said = deploying(world, game, capsys)
    assert done
    assert [one for one in (*STOPS, *GOES_ON) if re.search(pattern(one).removeprefix(r".*"), said)] == []
