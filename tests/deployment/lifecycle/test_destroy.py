"""destroy: what it deletes and keeps, what it asks, and that it can be repeated after any interruption."""

from __future__ import annotations

import json
import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from botocore.exceptions import ClientError

from hippodrome import cli
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.model.messages import StartServer
from hippodrome.deployment.aws.account import open_account
from hippodrome.deployment.aws.object_version import Version
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.lifecycle import destroy
from hippodrome.deployment.lifecycle.destroy import Removal
from hippodrome.deployment.stack.code_bucket import CodeBucket
from hippodrome.deployment.stack.stack import FailedResource, NotDeleted, Stack
from testing.servers import Servers
from testing.studies import study
from testing.template import template
from tests.deployment.installation import Installed
from tests.deployment.stack_world import ACCOUNT, DOMAIN, REGION, World, function

DATA = "hippodrome-bucket-abc123"
TAG = [{"Key": "hippodrome:stack", "Value": "hippodrome"}]


@pytest.fixture
def installed(world: World) -> World:
    """An installation: a stack in the fake CloudFormation, and in moto what commands and functions made beside it."""
    s3, ecs = world.account.client("s3"), world.account.client("ecs")
    make_bucket(world, DATA, TAG)
    s3.put_bucket_versioning(Bucket=DATA, VersioningConfiguration={"Status": "Enabled"})
    for body in (b"old", b"new"):
        s3.put_object(Bucket=DATA, Key="study/users/u1/participant.json", Body=body)
    s3.put_object(Bucket=DATA, Key="study/users/u2/participant.json", Body=b"x")
    s3.delete_object(Bucket=DATA, Key="study/users/u2/participant.json")
    code = CodeBucket(world.account, "hippodrome")
    code.make()
    code.upload([function("sweep")])
    ecs.create_cluster(clusterName="hippodrome")
    for _ in range(2):
        define(world, "hippodrome-study", "hippodrome")
    define(world, "hippodrome-lab-study", "hippodrome-lab")
    define(world, "hippodrome-untagged", "")
    groups = ("/hippodrome/hippodrome/left", "/hippodrome/hippodrome-lab/sweep", "/hippodrome/hippodromes/x")
    for group in (
        *groups,
        "/aws/vendedlogs/hippodrome/hippodrome/api",
        "/aws/vendedlogs/hippodrome/hippodrome-lab/api",
    ):
        world.account.client("logs").create_log_group(logGroupName=group)
    for name in ("/hippodrome/hippodrome/LLM_KEY", "/hippodrome/hippodrome-lab/LLM_KEY"):
        world.account.client("ssm").put_parameter(Name=name, Value="sk-1", Type="SecureString")
    outputs = {
        "Bucket": DATA,
        "Cluster": "hippodrome",
        "HostedZoneId": world.zone,
        "RootDomain": DOMAIN,
        "ServersHost": "servers",
        "MaxRuntime": "120",
        "Subnets": "subnet-1",
        "SecurityGroup": "sg-1",
        "StartServerTopic": "arn:aws:sns:ca-central-1:123456789012:start",
        "StopServerTopic": "arn:aws:sns:ca-central-1:123456789012:stop",
        "ScheduleGroup": "hippodrome",
        "ScheduleRole": "arn:aws:iam::123456789012:role/schedule",
    }
    world.account.client("scheduler").create_schedule_group(Name="hippodrome")
    world.cloud.outputs = outputs
    world.stand(ServersHost="servers")
    world.cloud.resources = [
        {"LogicalResourceId": "Bucket", "PhysicalResourceId": DATA, "ResourceType": "AWS::S3::Bucket"},
        {
            "LogicalResourceId": "Log",
            "PhysicalResourceId": "/hippodrome/hippodrome/sweep",
            "ResourceType": "AWS::Logs::LogGroup",
        },
    ]
    return world


def make_bucket(world: World, name: str, tags: list[dict[str, str]], region: str = REGION) -> None:
    s3 = world.account.client("s3", region)
    s3.create_bucket(Bucket=name, CreateBucketConfiguration={"LocationConstraint": region})
    if tags:
        s3.put_bucket_tagging(Bucket=name, Tagging={"TagSet": tags})


def define(world: World, family: str, stack: str) -> None:
    world.account.client("ecs").register_task_definition(
        family=family,
        containerDefinitions=[{"name": "trial", "image": "x", "memory": 10}],
        tags=[{"key": "hippodrome:stack", "value": stack}] if stack else [],
    )


def buckets(world: World) -> set[str]:
    return {bucket["Name"] for bucket in world.account.client("s3").list_buckets()["Buckets"]}


def families(world: World) -> set[str]:
    found = world.account.client("ecs").list_task_definitions()["taskDefinitionArns"]
    return {arn.rsplit("/", 1)[1].split(":")[0] for arn in found}


def run(world: World, *arguments: str, monkeypatch: pytest.MonkeyPatch) -> int:
    monkeypatch.setattr(destroy, "open_account", lambda profile, region: world.account)
    return cli.main(["destroy", *arguments])


def test_destroy_deletes_all_but_the_data(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert buckets(installed) == {DATA}
    assert families(installed) == {"hippodrome-lab-study", "hippodrome-untagged"}
    groups = {g["logGroupName"] for g in installed.account.client("logs").describe_log_groups()["logGroups"]}
    assert groups == {
        "/hippodrome/hippodrome-lab/sweep",
        "/hippodrome/hippodromes/x",
        "/aws/vendedlogs/hippodrome/hippodrome-lab/api",
    }
    secrets = [one["Name"] for one in installed.account.client("ssm").describe_parameters()["Parameters"]]
    assert secrets == ["/hippodrome/hippodrome-lab/LLM_KEY"]
    assert installed.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    said = capsys.readouterr()
    assert f"stay in the bucket {DATA}" in said.err
    assert "destroy --stack hippodrome --data" in said.err
    assert "Nothing else is left" in said.err
    s3 = installed.account.client("s3")
    assert len(s3.list_object_versions(Bucket=DATA)["Versions"]) == 3


def last_commands(said: str) -> list[list[str]]:
    """Return the commands that the output names at its end, split as a shell would split them."""
    return [shlex.split(line)[1:] for line in said.splitlines() if line.startswith("  hippodrome ")]


def test_the_commands_that_destroy_names_fetch_and_delete_the_kept_data(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    s3 = installed.account.client("s3")
    for key in ("other/users/u1/answers/1.json", "pages/steps/1.html", "SSL/privkey.pem", "_servers/s1.json"):
        s3.put_object(Bucket=DATA, Key=key, Body=b"{}")
    assert run(installed, "--yes", "--region", REGION, monkeypatch=monkeypatch) == Exit.DONE
    *fetching, deleting = last_commands(capsys.readouterr().err)
    monkeypatch.delenv("AWS_REGION", raising=False)
    monkeypatch.chdir(tmp_path)
    assert [cli.main(command) for command in fetching] == [Exit.DONE, Exit.DONE]
    assert {path.name for path in tmp_path.iterdir()} == {"data-other", "data-study"}
    assert "u1" in (tmp_path / "data-study" / "answers.csv").read_text()
    assert cli.main([*deleting, "--yes"]) == Exit.DONE
    assert buckets(installed) == set()


def test_the_commands_that_destroy_names_keep_the_profile(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(installed, "--yes", "--profile", "my lab", monkeypatch=monkeypatch)
    named = last_commands(capsys.readouterr().err)
    assert [command[-4:] for command in named] == [["--region", REGION, "--profile", "my lab"]] * 2


def test_for_a_kept_bucket_without_participants_destroy_names_no_command_that_fetches_data(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed.account.client("s3").delete_object(Bucket=DATA, Key="study/users/u1/participant.json")
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    said = capsys.readouterr().err
    assert f"The bucket {DATA} stays; nobody's data are in it. S3 keeps deleted data for 30 days." in said
    assert [command[0] for command in last_commands(said)] == ["destroy"]


def test_destroy_and_the_template_agree_how_long_older_versions_are_kept() -> None:
    rules = template()["Resources"]["Bucket"]["Properties"]["LifecycleConfiguration"]["Rules"]
    (days,) = [rule["NoncurrentVersionExpiration"]["NoncurrentDays"] for rule in rules if rule["Id"] == "OldVersions"]
    assert days == 30


def test_a_log_group_that_a_function_writes_after_the_removal_is_removed_too(
    installed: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = installed.account.client("logs")
    remove = Removal._log_groups
    late = ["/hippodrome/hippodrome/late"]

    def remove_groups(self: Removal) -> None:
        remove(self)
        if late:
            logs.create_log_group(logGroupName=late.pop())

    monkeypatch.setattr(Removal, "_log_groups", remove_groups)
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert logs.describe_log_groups(logGroupNamePrefix="/hippodrome/hippodrome/")["logGroups"] == []


def test_what_is_left_is_named_and_the_command_fails(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Removal, "_log_groups", lambda self: None)
    assert run(installed, "--yes", "--json", monkeypatch=monkeypatch) == Exit.FAILED
    said = capsys.readouterr()
    assert {"kind": "log group", "name": "/hippodrome/hippodrome/left"} in json.loads(said.out)["things"]
    assert "Something is left of hippodrome" in said.err
    assert "log group: /hippodrome/hippodrome/left" in said.err
    assert "Nothing" not in said.err


def test_destroy_with_data_deletes_the_bucket(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.DONE
    assert buckets(installed) == set()


@pytest.mark.parametrize("late", [2, 3])
def test_a_bucket_into_which_something_is_written_meanwhile_is_emptied_again(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], late: int
) -> None:
    """The last recording of a server may come after its bucket was emptied. After three rounds destroy gives up."""
    s3, empty, writes = installed.account.client("s3"), VersionedBucket.empty, [DATA] * late

    def empty_slowly(self: VersionedBucket, note: Callable[[Sequence[Version]], None]) -> None:
        empty(self, note)
        if self.name in writes:
            writes.pop()
            s3.put_object(Bucket=self.name, Key="study/recordings/late", Body=b"x")

    monkeypatch.setattr(VersionedBucket, "empty", empty_slowly)
    emptied = late < destroy.ROUNDS
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == (Exit.DONE if emptied else Exit.FAILED)
    assert buckets(installed) == (set() if emptied else {DATA})
    assert (f"S3 bucket: {DATA}" in capsys.readouterr().err) is not emptied


def test_the_data_can_be_deleted_by_a_later_run(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    installed.cloud.resources = []  # CloudFormation has forgotten the stack; the bucket's tag remains
    installed.cloud.stack = None
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert buckets(installed) == {DATA}
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.DONE
    assert buckets(installed) == set()
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.DONE


def test_other_installations_are_not_touched(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    make_bucket(installed, "hippodrome-lab-bucket-1", [{"Key": "hippodrome:stack", "Value": "hippodrome-lab"}])
    make_bucket(installed, "hippodrome-bucket-elsewhere", TAG, region="eu-west-1")
    make_bucket(installed, "hippodrome-notes", [])
    run(installed, "--yes", "--data", monkeypatch=monkeypatch)
    assert buckets(installed) == {"hippodrome-lab-bucket-1", "hippodrome-bucket-elsewhere", "hippodrome-notes"}


def test_a_bucket_without_our_tag_gets_it_before_the_stack_is_deleted(installed: World) -> None:
    s3 = installed.account.client("s3")
    s3.put_bucket_tagging(Bucket=DATA, Tagging={"TagSet": [{"Key": "owner", "Value": "lab"}]})
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    removal.run(removal.look(), data=False)
    tags = {tag["Key"]: tag["Value"] for tag in s3.get_bucket_tagging(Bucket=DATA)["TagSet"]}
    assert tags == {"owner": "lab", "hippodrome:stack": "hippodrome"}


def test_a_dry_run_changes_nothing(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = buckets(installed), families(installed)
    assert run(installed, "--dry-run", "--data", monkeypatch=monkeypatch) == Exit.CHANGES
    assert (buckets(installed), families(installed)) == before
    assert not installed.cloud.called("delete_stack")
    assert "every version" in capsys.readouterr().err
    assert run(installed, "--dry-run", "--json", monkeypatch=monkeypatch) == Exit.CHANGES
    found = json.loads(capsys.readouterr().out)
    assert found["stack"] == "CREATE_COMPLETE"
    assert found["data"] == [DATA]
    assert {"kind": "log group", "name": "/hippodrome/hippodrome/left"} in found["things"]


def test_when_only_data_are_left_a_run_without_data_has_nothing_to_do(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert "Nothing else is left of" in capsys.readouterr().err
    assert run(installed, "--dry-run", monkeypatch=monkeypatch) == Exit.DONE
    assert run(installed, "--dry-run", "--data", monkeypatch=monkeypatch) == Exit.CHANGES
    assert run(installed, "--data", "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert "Nothing is left of" in capsys.readouterr().err


def test_destroy_without_an_installation_is_done(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert run(world, "--dry-run", monkeypatch=monkeypatch) == Exit.DONE


def test_without_a_terminal_destroy_needs_yes(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(installed, monkeypatch=monkeypatch) == Exit.DECLINED
    assert not installed.cloud.called("delete_stack")


@pytest.mark.parametrize(("typed", "code"), [("hippodrome", Exit.DONE), ("hippo", Exit.DECLINED), ("y", Exit.DECLINED)])
def test_the_stacks_name_has_to_be_typed(
    installed: World, monkeypatch: pytest.MonkeyPatch, typed: str, code: Exit
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("builtins.input", lambda: typed)
    assert run(installed, monkeypatch=monkeypatch) == code
    assert bool(installed.cloud.called("delete_stack")) == (code == Exit.DONE)


def test_tasks_are_stopped_first(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    running = [["arn:task/1", "arn:task/2"], ["arn:task/2"], []]
    monkeypatch.setattr(EcsTasks, "arns", lambda self, cluster: running.pop(0))

    def stop_task(**arguments: Any) -> Any:
        order.append(arguments["task"])

    monkeypatch.setattr(installed.account.client("ecs"), "stop_task", stop_task, raising=False)
    delete = installed.cloud.delete_stack
    monkeypatch.setattr(installed.cloud, "delete_stack", lambda **a: (order.append("stack"), delete(**a))[1])
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    removal.run(removal.look(), data=False)
    assert order == ["arn:task/1", "arn:task/2", "arn:task/2", "stack"]


def test_a_deletion_that_a_new_server_blocked_is_tried_again(installed: World) -> None:
    reason = "The Cluster cannot be deleted while it contains Tasks."
    failing = [
        ("DELETE_IN_PROGRESS", [("Cluster", "AWS::ECS::Cluster", "DELETE_FAILED", reason)]),
        ("DELETE_FAILED", []),
    ]
    installed.cloud.operations = [list(failing)]
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    removal.run(removal.look(), data=False)
    assert len(installed.cloud.called("delete_stack")) == 2
    assert installed.cloud.stack["StackStatus"] == "DELETE_COMPLETE"


def test_a_failed_deletion_is_reported_and_keeps_the_data(installed: World) -> None:
    failing = [
        ("DELETE_IN_PROGRESS", [("Zone", "AWS::X::Y", "DELETE_FAILED", "You are not authorized")]),
        ("DELETE_FAILED", []),
    ]
    installed.cloud.operations = [failing]
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    with pytest.raises(Problem, match="could not be deleted"):
        removal.run(removal.look(), data=True)
    assert DATA in buckets(installed)  # the data are deleted last
    removal.run(removal.look(), data=True)
    assert buckets(installed) == set()


def test_the_run_after_an_interruption_finishes(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    """The run after an interruption at any of these steps finishes."""
    for step in ("_stop_servers", "_acme_records", "_task_definitions", "_bucket"):
        with monkeypatch.context() as patch:

            def interrupt(*_: Any) -> None:
                raise KeyboardInterrupt

            patch.setattr(Removal, step, interrupt)
            assert run(installed, "--yes", monkeypatch=patch) == Exit.INTERRUPTED
        if installed.cloud.stack["StackStatus"] == "DELETE_COMPLETE" and step == "_acme_records":
            break
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.DONE
    assert buckets(installed) == set()
    assert families(installed) == {"hippodrome-lab-study", "hippodrome-untagged"}


def test_a_missing_cluster_and_bucket_are_no_error(installed: World) -> None:
    installed.account.client("ecs").delete_cluster(cluster="hippodrome")
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    removal._bucket(DATA, "data")
    removal.run(removal.look(), data=True)
    assert buckets(installed) == set()


def test_challenge_records_of_ours_are_deleted_and_others_stay(installed: World) -> None:
    route53 = installed.account.client("route53")

    def put(name: str, kind: str, ttl: int, value: str) -> None:
        change = {
            "Action": "UPSERT",
            "ResourceRecordSet": {"Name": name, "Type": kind, "TTL": ttl, "ResourceRecords": [{"Value": value}]},
        }
        route53.change_resource_record_sets(HostedZoneId=installed.zone, ChangeBatch={"Changes": [change]})

    put("_acme-challenge.servers.example.org", "TXT", 60, '"ours"')
    put("_acme-challenge.www.example.org", "TXT", 60, '"another one\'s"')
    put("mail.example.org", "TXT", 60, '"x"')
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    removal.run(removal.look(), data=False)
    records = route53.list_resource_record_sets(HostedZoneId=installed.zone)["ResourceRecordSets"]
    assert {r["Name"] for r in records if r["Type"] == "TXT"} == {
        "_acme-challenge.www.example.org.",
        "mail.example.org.",
    }


def test_more_data_than_a_page_are_deleted(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MOTO_S3_DEFAULT_MAX_KEYS", "5")  # keys in a page; S3's has 1,000
    s3 = installed.account.client("s3")
    for number in range(23):
        s3.put_object(Bucket=DATA, Key=f"study/users/u/trials/{number}", Body=b"")
    removal = Removal(installed.account, "hippodrome", Executor(lambda _: None))
    removal._bucket(DATA, "data")
    assert DATA not in buckets(installed)


def test_the_name_of_the_code_bucket_holds_the_account_id(world: World) -> None:
    assert ACCOUNT in CodeBucket(world.account, "hippodrome").name


def test_a_foreign_stack_is_left_alone(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    assert installed.cloud.stack
    installed.cloud.stack |= {"Tags": [], "Parameters": []}
    before = buckets(installed)
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.FAILED
    assert installed.cloud.stack["StackStatus"] == "CREATE_COMPLETE"
    assert buckets(installed) == before


def test_remains_of_a_foreign_deleted_stack_are_left_alone(installed: World, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = "hippodrome-photographs"
    make_bucket(installed, theirs, [])
    assert installed.cloud.stack
    installed.cloud.stack |= {"Tags": [], "Parameters": [], "StackStatus": "DELETE_COMPLETE"}
    installed.cloud.resources = [
        {"LogicalResourceId": "B", "PhysicalResourceId": theirs, "ResourceType": "AWS::S3::Bucket"},
    ]
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.DONE
    assert buckets(installed) == {theirs}


def test_warm_servers_are_stopped_also_those_that_start_meanwhile(
    monkeypatch: pytest.MonkeyPatch, access_keys: None
) -> None:
    """The sweep of a live study starts warm servers again until the sweep itself is deleted."""
    kept = study(task_definition="hippodrome", warm_servers=2)
    with Installed() as installation:
        installation.register(kept)
        installation.warm(kept, 2)
        Servers(installation.platform).start(StartServer(kept.id, "alice"))
        removal = Removal(open_account(), "hippodrome", Executor(lambda _: None))
        tries: list[int] = []

        def delete(self: Stack, title: str, without: Sequence[str]) -> None:
            tries.append(len(list(installation.platform.tasks.list())))
            if len(tries) == 1:
                installation.warm(kept, 2)
                reason = "The Cluster cannot be deleted while Tasks are active."
                failure = FailedResource("Cluster", "AWS::ECS::Cluster", "hippodrome", reason)
                raise NotDeleted(Problem("The stack could not be deleted."), [failure])

        monkeypatch.setattr(Stack, "delete", delete)
        removal.run(removal.look(), data=False)
        assert tries[:2] == [0, 0]
        assert ([*installation.platform.tasks.list()], installation.records(), installation.timers()) == ([], {}, {})


@pytest.mark.parametrize("refused", [False, True])
def test_a_server_in_its_own_cluster_that_its_record_could_not_stop_is_stopped_before_the_stack_goes(
    refused: bool, monkeypatch: pytest.MonkeyPatch, access_keys: None
) -> None:
    own = study(task_definition="hippodrome", cluster="participant")
    with Installed() as installation:
        installation.register(own)
        Servers(installation.platform).start(StartServer(own.id, "alice"))
        [task] = installation.platform.tasks.list()
        removal = Removal(open_account(), "hippodrome", Executor(lambda _: None))
        deleted: list[list[Any]] = []

        def stop(*_: Any) -> None:
            raise ClientError({"Error": {"Code": "ServerException", "Message": "no"}}, "StopTask")

        monkeypatch.setattr(EcsTasks, "stop", stop)
        monkeypatch.setattr(Stack, "delete", lambda *_: deleted.append([*installation.platform.tasks.list()]))
        if refused:
            monkeypatch.setattr("hippodrome.deployment.lifecycle.destroy._remove", lambda *_, **__: None)
            with pytest.raises(Problem, match=task.cluster):
                removal.run(removal.look(), data=False)
        else:
            removal.run(removal.look(), data=False)
        assert task.cluster != installation.platform.settings.cluster
        assert deleted[:1] == ([] if refused else [[]])
