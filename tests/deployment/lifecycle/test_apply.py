"""plan and apply: their calls of CloudFormation, what they print, and their answers to failures."""

from __future__ import annotations

import json
from typing import Any

import pytest

from hippodrome import cli
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.lifecycle import apply as applying
from hippodrome.deployment.lifecycle import deploy
from hippodrome.deployment.lifecycle import plan as plans
from hippodrome.deployment.lifecycle.apply import ApplyRequest, apply, plan
from hippodrome.deployment.stack.changes import Prepared
from hippodrome.deployment.stack.settings import StackSettings
from tests.deployment.fake_cloudformation import NOTHING, changed_resource, happy, invalid, refusal
from tests.deployment.stack_world import ACCOUNT, DOMAIN, REGION, World, function

FIRST = StackSettings(domain=DOMAIN)
AGAIN = StackSettings()
OUTPUTS = {"Site": "https://study.example.org", "Bucket": "hippodrome-bucket-1"}


def write_calls(world: World) -> list[str]:
    return [name for name, _ in world.cloud.calls if not name.startswith(("get_", "describe_", "list_"))]


# -- creating and updating ---------------------------------------------------------------------------------------------------------


def test_the_first_apply_creates_the_stack(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.cloud.outputs = OUTPUTS
    outcome = apply(world.account, "hippodrome", FIRST)
    assert outcome.changed
    assert outcome.outputs == OUTPUTS
    (asked,) = world.cloud.called("create_change_set")
    assert asked["ChangeSetType"] == "CREATE"
    assert asked["Capabilities"] == ["CAPABILITY_NAMED_IAM"]
    assert asked["Tags"] == [{"Key": "hippodrome:stack", "Value": "hippodrome"}]
    assert {one["ParameterKey"]: one["ParameterValue"] for one in asked["Parameters"]} == world.parameters()
    (executed,) = world.cloud.called("execute_change_set")
    assert executed["RetainExceptOnCreate"] is True
    assert not world.cloud.called("delete_change_set")
    s3 = world.account.client("s3")
    keys = {one["Key"] for one in s3.list_objects_v2(Bucket=world.code_bucket)["Contents"]}
    assert {function("sweep").key, function("next_step").key} <= keys
    assert function("unused").key not in keys
    body = s3.get_object(Bucket=world.code_bucket, Key=next(key for key in keys if key.endswith(".yml")))["Body"].read()
    assert body.decode() == world.built.text
    said = capsys.readouterr().err
    assert "will be made" in said
    assert "up to date" in said


def test_apply_without_changes_does_nothing(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.stand()
    outcome = apply(world.account, "hippodrome", AGAIN)
    assert not outcome.changed
    assert write_calls(world) == []
    assert world.account.client("s3").list_buckets()["Buckets"] == []
    assert "Nothing to do" in capsys.readouterr().err


@pytest.mark.parametrize("status", ["UPDATE_COMPLETE", "UPDATE_ROLLBACK_COMPLETE"])
def test_apply_without_changes_does_nothing_after_updates_either(world: World, status: str) -> None:
    world.stand(status)
    assert not apply(world.account, "hippodrome", AGAIN).changed
    assert write_calls(world) == []


def test_white_space_that_cloudformation_cut_off_is_no_change(world: World) -> None:
    world.stand()
    world.cloud.text = world.cloud.text.strip()
    assert not apply(world.account, "hippodrome", AGAIN).changed


def test_non_ascii_characters_that_cloudformation_replaces_are_no_change(world: World) -> None:
    """GetTemplate answers with question marks for characters that are not ASCII."""
    world.text += "# participants open …/next — 請\n"
    world.stand()
    world.cloud.text = world.cloud.text.encode("ascii", "replace").decode()
    assert not apply(world.account, "hippodrome", AGAIN).changed
    assert write_calls(world) == []


def test_new_code_is_a_change(world: World) -> None:
    world.stand()
    world.functions = [function("next_step"), function("sweep", b"new\n")]
    world.cloud.changes = [changed_resource("Sweep", "AWS::Lambda::Function", "Code")]
    assert apply(world.account, "hippodrome", AGAIN).changed
    (asked,) = world.cloud.called("create_change_set")
    assert asked["ChangeSetType"] == "UPDATE"


def test_a_parameter_is_a_change(world: World) -> None:
    world.stand()
    world.cloud.changes = [changed_resource("Sweep", "AWS::Lambda::Function", "Environment")]
    assert apply(world.account, "hippodrome", StackSettings(max_runtime=30)).changed
    (asked,) = world.cloud.called("create_change_set")
    assert {"ParameterKey": "MaxRuntime", "ParameterValue": "30"} in asked["Parameters"]
    assert {"ParameterKey": "RootDomain", "ParameterValue": DOMAIN} in asked["Parameters"]


def test_a_missing_tag_is_a_change(world: World) -> None:
    world.stand()
    world.cloud.stack["Tags"] = []
    assert apply(world.account, "hippodrome", AGAIN).changed


@pytest.mark.parametrize("reason", [NOTHING, "No updates are to be performed."])
def test_a_change_set_without_changes_is_deleted(world: World, reason: str) -> None:
    world.stand()
    world.text += "\n# a comment\n"
    world.cloud.failing = reason
    assert not apply(world.account, "hippodrome", AGAIN).changed
    assert len(world.cloud.called("delete_change_set")) == 2  # an old one of ours, and the new one
    assert not world.cloud.called("execute_change_set")


def test_only_change_sets_of_our_interrupted_runs_are_removed(world: World) -> None:
    world.stand()
    world.text += "\n# a comment\n"
    apply(world.account, "hippodrome", AGAIN)
    assert [one["ChangeSetName"] for one in world.cloud.called("delete_change_set")] == ["old"]


# -- what CloudFormation does not want -----------------------------------------------------------------------------------


def test_a_failed_change_set_is_reported_and_leaves_no_stack(world: World) -> None:
    world.cloud.validation = lambda: [
        invalid("Sweep", "may be looked at by nobody", status="SKIPPED"),
        invalid("Vpc", "the quota is used up", "WARN"),
        invalid("Bucket", "it is taken"),
    ]
    with pytest.raises(Problem, match="EarlyValidation") as caught:
        apply(world.account, "hippodrome", FIRST)
    assert caught.value.details == ("Bucket: it is taken",)
    assert world.cloud.stack is None  # no empty stack remains


def test_warnings_of_validation_are_shown_and_do_not_stop_apply(
    world: World, capsys: pytest.CaptureFixture[str]
) -> None:
    world.cloud.validation = lambda: [
        invalid("Sweep", "may be looked at by nobody", "WARN", "SKIPPED"),
        invalid("Vpc", "the quota is used up", "WARN"),
    ]
    assert apply(world.account, "hippodrome", FIRST).changed
    said = capsys.readouterr().err
    assert "CloudFormation warns of Vpc: the quota is used up" in said
    assert "nobody" not in said


def test_a_refused_template_is_reported(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: Any) -> None:
        raise refusal("CreateChangeSet", "ValidationError", "Parameter MaxRuntime must be at least 5")

    monkeypatch.setattr(world.cloud, "create_change_set", refuse)
    with pytest.raises(Problem, match="MaxRuntime must be at least 5"):
        apply(world.account, "hippodrome", FIRST)


def test_a_failed_creation_is_reported_and_the_next_run_creates_the_stack(world: World) -> None:
    reason = "Resource handler returned message: The maximum number of VPCs has been reached."
    world.cloud.operations = [
        [
            ("CREATE_IN_PROGRESS", [("Bucket", "AWS::S3::Bucket", "CREATE_COMPLETE", "")]),
            ("ROLLBACK_IN_PROGRESS", [("Vpc", "AWS::EC2::VPC", "CREATE_FAILED", reason)]),
            ("ROLLBACK_COMPLETE", []),
        ]
    ]
    with pytest.raises(Problem, match="could not be made") as caught:
        apply(world.account, "hippodrome", FIRST)
    assert any(reason in line for line in caught.value.details)
    assert "--vpc" in caught.value.advice
    first = world.cloud.stack["StackId"]
    outcome = apply(world.account, "hippodrome", AGAIN)  # the domain is remembered
    assert outcome.changed
    assert world.cloud.called("delete_stack")
    assert world.cloud.stack["StackId"] != first
    assert world.cloud.stack["StackStatus"] == "CREATE_COMPLETE"


def test_a_failed_update_is_reported_with_its_cause(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.stand()
    world.cloud.operations = [
        [
            ("UPDATE_IN_PROGRESS", [("Sweep", "AWS::Lambda::Function", "UPDATE_FAILED", "API: lambda: Access Denied")]),
            ("UPDATE_ROLLBACK_IN_PROGRESS", [("Vpc", "AWS::EC2::VPC", "UPDATE_FAILED", "Resource update cancelled")]),
            ("UPDATE_ROLLBACK_COMPLETE", []),
        ]
    ]
    with pytest.raises(Problem, match="could not be updated") as caught:
        apply(world.account, "hippodrome", StackSettings(max_runtime=30))
    assert len(caught.value.details) == 2
    assert "permission" in caught.value.advice
    assert "Sweep failed" in capsys.readouterr().err


def test_a_failed_rollback_is_continued_before_the_next_update(world: World) -> None:
    world.stand("UPDATE_ROLLBACK_FAILED")
    world.cloud.operations = [[("UPDATE_ROLLBACK_IN_PROGRESS", []), ("UPDATE_ROLLBACK_COMPLETE", [])]]
    apply(world.account, "hippodrome", AGAIN)
    assert world.cloud.called("continue_update_rollback")
    world.stand("UPDATE_ROLLBACK_FAILED")
    world.cloud.operations = [[("UPDATE_ROLLBACK_IN_PROGRESS", []), ("UPDATE_ROLLBACK_FAILED", [])]]
    with pytest.raises(Problem, match="could not be taken back"):
        apply(world.account, "hippodrome", AGAIN)


def test_apply_waits_for_an_operation_in_progress(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.stand("UPDATE_IN_PROGRESS")
    world.cloud.script = [("UPDATE_IN_PROGRESS", []), ("UPDATE_IN_PROGRESS", []), ("UPDATE_COMPLETE", [])]
    assert not apply(world.account, "hippodrome", AGAIN).changed
    assert "waiting for that first" in capsys.readouterr().err


def test_a_stack_in_review_is_used(world: World) -> None:
    world.stand("REVIEW_IN_PROGRESS")
    outcome = apply(world.account, "hippodrome", FIRST)
    assert outcome.changed
    assert world.cloud.called("create_change_set")[0]["ChangeSetType"] == "CREATE"


def test_a_half_deleted_stack_is_refused_with_advice(world: World) -> None:
    world.stand("DELETE_FAILED")
    with pytest.raises(Problem, match="half deleted") as caught:
        apply(world.account, "hippodrome", AGAIN)
    assert "destroy --stack hippodrome" in caught.value.advice


def test_ctrl_c_during_the_creation_leaves_it_to_cloudformation(world: World) -> None:
    world.cloud.operations = [[("CREATE_IN_PROGRESS", [])] * 50]
    world.cloud.interrupt_after = 8
    with pytest.raises(Problem) as caught:
        apply(world.account, "hippodrome", FIRST)
    assert caught.value.exit_code == Exit.INTERRUPTED
    assert world.cloud.stack["StackStatus"] == "CREATE_IN_PROGRESS"
    assert not world.cloud.called("delete_stack")
    world.cloud.script = happy("CREATE")
    world.cloud.text = world.built.text
    assert not apply(world.account, "hippodrome", AGAIN).changed


# -- what would be lost --------------------------------------------------------------------------------------------------


def replaced(kind: str, **more: Any) -> dict[str, Any]:
    return changed_resource("Thing", kind, "Name", **({"Replacement": "True"} | more))


def test_a_change_that_loses_something_needs_a_yes(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    world.stand()
    world.cloud.changes = [replaced("AWS::SQS::Queue")]
    with pytest.raises(Problem) as caught:
        apply(world.account, "hippodrome", StackSettings(max_runtime=30))
    assert caught.value.exit_code == Exit.DECLINED
    assert "messages on their way are lost" in capsys.readouterr().err
    assert not world.cloud.called("execute_change_set")
    assert len(world.cloud.called("delete_change_set")) == 2
    assert apply(world.account, "hippodrome", StackSettings(max_runtime=30), ApplyRequest(yes=True)).changed


def test_nothing_is_changed_if_the_certificate_for_new_server_names_fails(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(prepared: Prepared) -> None:
        raise Problem("no certificate")

    monkeypatch.setattr("hippodrome.deployment.stack.domain_change.certify", fails)
    world.stand()
    world.cloud.changes = [changed_resource("Sweep", "AWS::Lambda::Function", "Environment")]
    with pytest.raises(Problem, match="no certificate"):
        apply(world.account, "hippodrome", StackSettings(max_runtime=30))
    assert not world.cloud.called("execute_change_set")


@pytest.mark.parametrize(
    ("change", "danger"),
    [
        (replaced("AWS::S3::Bucket", PolicyAction="ReplaceAndRetain"), "stays in AWS with participants' data"),
        (replaced("AWS::S3::Bucket", PolicyAction="ReplaceAndDelete"), "participants' data are lost"),
        (replaced("AWS::ECR::Repository"), "images are lost"),
        (replaced("AWS::ECS::Cluster", Replacement="Conditional"), "may be replaced"),
        (replaced("AWS::Logs::LogGroup", Action="Remove"), "is removed"),
        (replaced("AWS::ApiGatewayV2::DomainName"), "links that participants have are lost"),
        (replaced("AWS::IAM::Role"), ""),
        (changed_resource("Thing", "AWS::S3::Bucket", "LifecycleConfiguration"), ""),
    ],
)
def test_replaced_and_removed_resources_with_data_are_dangers(
    world: World, change: dict[str, Any], danger: str
) -> None:
    (found,) = plans.of_change_set([change], world.built)
    assert danger in found.danger
    assert bool(danger) == bool(found.danger)


# -- the plan ------------------------------------------------------------------------------------------------------------


def test_a_plan_of_a_new_stack_asks_nothing_of_aws(world: World) -> None:
    found = plan(world.account, "hippodrome", FIRST)
    assert found.kind == "create"
    assert {change.name for change in found.changes} == {"Bucket", "Vpc", "EitherThing", "sweep", "next_step"}
    assert world.cloud.calls == []
    assert world.account.client("s3").list_buckets()["Buckets"] == []


def test_a_plan_of_an_update_leaves_no_change_set(world: World) -> None:
    world.stand()
    applying.prepare(world.account, "hippodrome", AGAIN).bucket.make()
    world.cloud.changes = [
        changed_resource("Sweep", "AWS::Lambda::Function", "Code"),
        changed_resource("NextStep", "AWS::Lambda::Function", "Code", "Timeout"),
        changed_resource("Vpc", "AWS::EC2::VPC", "CidrBlock", Replacement="True"),
    ]
    world.cloud.validation = lambda: [invalid("Vpc", "the quota is used up", "WARN")]
    found = plan(world.account, "hippodrome", StackSettings(max_runtime=30))
    assert found.kind == "update"
    assert [(one.check, one.text) for one in found.findings] == [("CloudFormation", "Vpc: the quota is used up")]
    assert [(change.name, change.action, change.properties) for change in found.changes] == [
        ("sweep", "change", ("Code",)),
        ("next_step", "change", ("Code", "Timeout")),
        ("Vpc", "replace", ("CidrBlock",)),
    ]
    assert found.parameters == {"MaxRuntime": ("120", "30")}
    assert len(found.dangers) == 1
    assert len(world.cloud.called("delete_change_set")) == 1
    assert not world.cloud.called("execute_change_set")
    text = [line for line, _ in found.lines()]
    assert "  MaxRuntime: 120 → 30" in text
    assert "  ~ new code: sweep" in text
    assert "  ~ next_step (Lambda Function) Code, Timeout" in text
    assert any("running servers are lost" in line for line in text)


def test_a_plan_of_an_update_needs_the_code_bucket(world: World) -> None:
    world.stand()
    with pytest.raises(Problem, match="code bucket"):
        plan(world.account, "hippodrome", StackSettings(max_runtime=30))


def test_a_plan_without_changes_says_so(world: World) -> None:
    world.stand()
    assert plan(world.account, "hippodrome", AGAIN).kind == "nothing"
    assert write_calls(world) == []


# -- the commands --------------------------------------------------------------------------------------------------------


@pytest.fixture
def command(world: World, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs `hippodrome deploy` for the installation alone. Ordering certificates has tests of its own."""
    monkeypatch.setattr(deploy, "open_account", lambda profile, region: world.account)
    return lambda *arguments: cli.main(["deploy", "--no-study", "--no-certificate", *arguments])


def test_plan_and_deploy_have_their_exit_codes(world: World, command: Any, capsys: pytest.CaptureFixture[str]) -> None:
    assert command("--plan", "--domain", DOMAIN) == Exit.CHANGES
    assert command("--dry-run", "--domain", DOMAIN) == Exit.CHANGES
    assert not world.cloud.calls
    assert command("--domain", DOMAIN) == Exit.DONE
    world.cloud.text = world.built.text
    assert command("--plan") == Exit.DONE
    assert command("--plan", "--max-runtime", "4") == 2
    assert command("--plan", "--domain", "no domain") == Exit.FAILED
    assert "Traceback" not in capsys.readouterr().err


def test_the_plan_of_a_new_stack_names_functions_and_counts_the_rest(
    world: World, command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    command("--plan", "--domain", DOMAIN)
    assert capsys.readouterr().out.splitlines() == [
        "The stack hippodrome in ca-central-1 will be made:",
        "  + 2 functions: next_step, sweep",
        "  + 3 other resources: 1 S3 Bucket, 1 EC2 VPC, 1 SNS Topic",
        "Participants will open https://study.example.org/next",
    ]


def test_the_plan_can_be_had_in_json(world: World, command: Any, capsys: pytest.CaptureFixture[str]) -> None:
    command("--plan", "--domain", DOMAIN, "--json")
    found = json.loads(capsys.readouterr().out)
    assert found["kind"] == "create"
    assert {"action": "create", "name": "sweep"}.items() <= found["changes"][-2].items()
    world.cloud.text, world.cloud.outputs = world.built.text, OUTPUTS
    world.stand()
    world.account.client("s3").create_bucket(
        Bucket=world.code_bucket, CreateBucketConfiguration={"LocationConstraint": REGION}
    )
    command("--plan", "--max-runtime", "30", "--json")
    assert json.loads(capsys.readouterr().out)["parameters"] == {"MaxRuntime": {"before": "120", "after": "30"}}


def test_deploy_says_that_the_address_for_alarms_has_to_be_confirmed(
    world: World, command: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    command("--domain", DOMAIN, "--email", "me@example.org")
    said = " ".join(capsys.readouterr().err.split())
    assert "AWS has sent a mail to me@example.org: alarms come only after its link has been clicked." in said


def test_the_account_id_is_that_of_the_credentials(world: World) -> None:
    assert world.account.id == ACCOUNT


@pytest.mark.parametrize(
    "status", ["CREATE_COMPLETE", "UPDATE_IN_PROGRESS", "UPDATE_ROLLBACK_FAILED", "ROLLBACK_COMPLETE"]
)
def test_a_foreign_stack_of_that_name_is_left_alone(world: World, status: str) -> None:
    world.cloud.stand(status, {"InstanceType": "t3.micro"}, "Resources: {}")
    assert world.cloud.stack
    world.cloud.stack["Tags"] = [{"Key": "owner", "Value": "somebody else"}]
    for act in (apply, plan):
        with pytest.raises(Problem, match="no installation of Hippodrome"):
            act(world.account, "hippodrome", FIRST)
    assert write_calls(world) == []


def test_an_installation_without_our_tag_is_recognized(world: World) -> None:
    world.stand()
    assert world.cloud.stack
    world.cloud.stack["Tags"] = []
    world.cloud.operations.append(happy("UPDATE"))
    assert apply(world.account, "hippodrome", AGAIN).changed
