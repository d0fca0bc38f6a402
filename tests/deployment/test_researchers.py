"""The researchers' policy allows every call of the commands that researchers run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.ports import TaskRequest
from hippodrome.control.storage.secret import KEY, SecretCache
from testing.iam.actions import Ask
from testing.iam.enforcement import account_of
from testing.iam.judge import MISSING, Judge, evaluator
from testing.studies import study
from tests.deployment.registering import RegisterWorld
from tests.infra.test_researchers import SHOWN

AS_IAM = {
    "s3:ListObjectsV2": "s3:ListBucket",
    "s3:HeadObject": "s3:GetObject",
    "lambda:Invoke": "lambda:InvokeFunction",
}
FREE = {"sts:GetCallerIdentity"}  # every identity may call this
REFUSED = {"logs:DescribeLogGroups"}  # this action has no resources; `logs` goes on without it


@pytest.mark.parametrize(
    "command",
    [
        "status --all",
        "cost maze --spent",
        "links maze --new 2",
        "logs --all --function next_step",
        "data maze --to {folder}",
    ],
)
def test_a_command_of_researchers_needs_no_more_than_their_policy(
    register_world: RegisterWorld, capsys: Any, tmp_path: Path, command: str
) -> None:
    if evaluator() is None:
        pytest.skip(MISSING)
    SecretCache(register_world.platform.documents).get_or_create()
    register_world.register(study(signed_links=True))
    register_world.participant("alice", answered=2)
    register_world.record("alice", nonce="n")
    register_world.platform.tasks.run(
        TaskRequest(f"s{'a' * 20}-1", "hippodrome", "hippodrome", 0.25, 0.5, {"TOKEN": "t"})
    )
    for action in REFUSED:
        register_world.refuse(action, lambda _: True, "AccessDeniedException", "not a researcher's")
    register_world.client("logs").create_log_group(logGroupName="/hippodrome/hippodrome/next_step")
    register_world.asked.clear()
    ran = register_world.run(capsys, *command.format(folder=tmp_path / "out").split())
    assert ran.code == Exit.DONE, ran.err
    made = {AS_IAM.get(action, action) for action, _ in register_world.asked} - FREE
    assert made, "it has asked for something"
    assert made - SHOWN.keys() - REFUSED == set()
    judge = Judge(account_of(register_world))
    keys = {told["Key"] for action, told in register_world.asked if action == "s3:GetObject"}
    bucket = f"arn:aws:s3:::{register_world.env['BUCKET']}"
    assert [key for key in keys if not judge.may("ResearcherPolicy", Ask("s3:GetObject", f"{bucket}/{key}"))] == []
    assert KEY not in keys
