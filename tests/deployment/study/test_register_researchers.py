"""Several researchers register at once; the permissions that they need."""

from __future__ import annotations

import dataclasses
import threading
from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.deployment.aws.account import find_installation
from hippodrome.deployment.study import register
from testing.aws_events import ACCOUNT
from testing.iam.actions import Ask
from testing.iam.enforcement import account_of
from testing.iam.judge import Judge, evaluator
from tests.deployment.installation import account_here
from tests.deployment.registering import CONFIG, RegisterWorld, write_study

Capsys = pytest.CaptureFixture[str]


# --- several people -----------------------------------------------------------------------------------------------


def _together(register_world: RegisterWorld, *folders: Path) -> list[dict[str, Any] | BaseException]:
    """Register these folders at the same moment."""
    account = account_here()
    installation = find_installation(account)
    gate, results = threading.Barrier(len(folders)), [None] * len(folders)

    def work(index: int, folder: Path) -> None:
        gate.wait()
        try:
            results[index] = register.register(account_here(), installation, folder, register.RegisterRequest())
        except BaseException as error:  # noqa: BLE001 - whatever it was, it is looked at
            results[index] = error

    threads = [threading.Thread(target=work, args=one) for one in enumerate(folders)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return results


def test_two_projects_registered_at_once_are_both_registered(
    register_world: RegisterWorld, tmp_path: Path, access_keys: None
) -> None:
    names = [f"study-{number}" for number in range(4)]
    folders = [write_study(tmp_path / name, CONFIG.replace("id: maze", f"id: {name}")) for name in names]
    results = _together(register_world, *folders)
    assert [result["project"] for result in results] == names, results
    for name in names:
        project = register_world.project(name)
        assert project is not None
        assert [project.task_definition] == register_world.revisions(f"hippodrome-{name}")
        assert len(register_world.keys(f"{name}/steps/")) == 3


def test_two_versions_registered_at_once_both_succeed_and_share_one_image(
    register_world: RegisterWorld, tmp_path: Path, access_keys: None
) -> None:
    folders = [
        write_study(tmp_path / who, CONFIG.replace("A maze", who), steps__thanks_DOT_html=who) for who in ("Ada", "Bob")
    ]
    results = _together(register_world, *folders)
    assert all(isinstance(result, dict) for result in results), results
    assert register_world.project().name in ("Ada", "Bob")
    assert register_world.get("maze/steps/thanks.html") in (b"Ada", b"Bob")
    assert len(register_world.image_tags()) == 1


# --- what a researcher must be allowed ----------------------------------------------------------------------------


def _asks(register_world: RegisterWorld, action: str, params: dict[str, Any]) -> list[Ask]:
    """Return the permissions that a call of `register` needs, by AWS's Service Authorization Reference."""
    here, bucket = f"us-east-1:{ACCOUNT}", f"arn:aws:s3:::{register_world.env['BUCKET']}"
    stack, families = f"arn:aws:cloudformation:{here}:stack/hippodrome/1", f"arn:aws:ecs:{here}:task-definition"
    service, operation = action.split(":")
    if service == "s3":
        name = {"HeadObject": "GetObject", "ListObjectsV2": "ListBucket"}.get(operation, operation)
        return [Ask(f"s3:{name}", bucket if name == "ListBucket" else f"{bucket}/{params['Key']}")]
    if action == "ecs:RegisterTaskDefinition":
        new = f"{families}/{params['family']}:*"
        to = {"iam:PassedToService": "ecs-tasks.amazonaws.com"}
        tag = Ask("ecs:TagResource", new, {"ecs:CreateAction": "RegisterTaskDefinition"})
        return [Ask(action, new), tag, Ask("iam:PassRole", params["executionRoleArn"], to)]
    return [
        {
            "cloudformation:DescribeStacks": Ask(action, stack),
            "ecr:GetAuthorizationToken": Ask(action, "*"),
            "ecr:DescribeImages": Ask(action, f"arn:aws:ecr:{here}:repository/hippodrome"),
            "ecs:DescribeTaskDefinition": Ask(action, "*"),
            "lambda:Invoke": Ask(
                "lambda:InvokeFunction", f"arn:aws:lambda:{here}:function:{register_world.outputs['RegisterFunction']}"
            ),
        }[action]
    ]


@pytest.mark.skipif(evaluator() is None, reason="no evaluator of policies is installed; tests/infra says so aloud")
def test_the_researchers_policy_allows_register_and_refuses_more(
    register_world: RegisterWorld, folder: Path, capsys: Capsys
) -> None:
    repository = f"arn:aws:ecr:us-east-1:{ACCOUNT}:repository/hippodrome"
    account = account_of(register_world)
    function = f"arn:aws:lambda:us-east-1:{ACCOUNT}:function:{register_world.outputs['RegisterFunction']}"
    known = {"Repository.Arn": repository, "UpdateProjectMasterList.Arn": function}
    judge = Judge(dataclasses.replace(account, known={**account.known, **known}))
    assert register_world.run(capsys, "register", str(folder)).code == Exit.DONE
    (folder / "steps/maze.png").unlink()
    (folder / "agent.py").write_text("class Agent:\n    x = 1\n")
    assert register_world.run(capsys, "register", str(folder), "--no-live").code == Exit.DONE
    assert "s3:DeleteObject" in register_world.made
    for action, params in register_world.asked:
        for ask in _asks(register_world, action, params):
            assert judge.may("ResearcherPolicy", ask), ask
    bucket = f"arn:aws:s3:::{register_world.env['BUCKET']}"
    for ask in (
        Ask("s3:PutObject", f"{bucket}/project_master_list.json"),
        Ask("s3:PutObject", f"{bucket}/maze/users/ada/answers/1.json"),
        Ask("s3:DeleteObject", f"{bucket}/maze/users/ada/answers/1.json"),
        Ask("s3:GetObject", f"{bucket}/SSL/privkey.pem"),
        Ask("iam:PassRole", f"arn:aws:iam::{ACCOUNT}:role/admin", {"iam:PassedToService": "ecs-tasks.amazonaws.com"}),
        Ask("ecr:BatchDeleteImage", repository),
        Ask("ecs:RunTask", f"arn:aws:ecs:us-east-1:{ACCOUNT}:task-definition/hippodrome-maze:1"),
    ):
        assert not judge.may("ResearcherPolicy", ask), ask
