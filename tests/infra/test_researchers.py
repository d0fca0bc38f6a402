"""What the researchers' policy shows: no token, no secret, no credential. Judged by the policy in the template.

First what it allows at all, action by action; then every document of an installation in which somebody plays; then each
other way that leads to what servers are told or to what functions keep.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from hippodrome.control.model import ids
from hippodrome.control.storage.secret import KEY
from hippodrome.functions import update_project_master_list
from testing import derived
from testing import template as cfn
from testing.iam.actions import Ask
from testing.iam.enforcement import account_of
from testing.iam.judge import Judge
from testing.moto_study import PROJECT, Person, StudyOnMoto
from testing.moto_world import MotoWorld

POLICY = "ResearcherPolicy"
LENT = ("TaskExecutionRole",)
"""Roles that others use for researchers, who say what is done: a task definition's containers."""

SHOWN = {  # every action of the policy: what it shows or does. Who adds one says why it shows no secret
    "cloudformation:DescribeStacks": "parameters and outputs, none of which is a secret",
    "cloudformation:ListStackResources": "names",
    "s3:ListBucket": "keys, which hold ids, but no secrets",
    "s3:GetObject": "documents: see the test below",
    "s3:PutObject": "pages",
    "s3:DeleteObject": "pages",
    "lambda:InvokeFunction": "registers projects and signs links; its answers are looked at below",
    "ecr:GetAuthorizationToken": "a password for images alone",
    "ecr:BatchCheckLayerAvailability": "images",
    "ecr:BatchGetImage": "images, which are made of projects",
    "ecr:CompleteLayerUpload": "images",
    "ecr:DescribeImages": "images",
    "ecr:GetDownloadUrlForLayer": "images",
    "ecr:InitiateLayerUpload": "images",
    "ecr:PutImage": "images",
    "ecr:UploadLayerPart": "images",
    "ecs:RegisterTaskDefinition": "what servers run; with no other role than the one that pulls images",
    "ecs:TagResource": "tags of those",
    "ecs:DescribeTaskDefinition": "what servers run. What each is told is part of its task, not of the definition",
    "iam:PassRole": "the role that pulls images",
    "ecs:ListTasks": "ids of tasks. DescribeTasks would show what they are told",
    "ecs:ListClusters": "names",
    "sqs:GetQueueAttributes": "how many messages wait, not what they say",
    "cloudwatch:DescribeAlarms": "alarms",
    "cloudwatch:GetMetricData": "counts",
    "ce:GetCostAndUsage": "money",
    "ssm:DescribeParameters": "names and dates of parameters, not what they hold",
    "ssm:PutParameter": "stores the key of a language model, and tells only its number of versions",
    "ssm:DeleteParameter": "removes that key",
    "logs:DescribeLogStreams": "names",
    "logs:FilterLogEvents": "logs, which hold no secrets: test_handlers.py, ministack/test_installation.py",
    "logs:GetLogEvents": "logs",
}


def statements(of: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = (of or cfn.template())["Resources"][POLICY]["Properties"]["PolicyDocument"][
        "Statement"
    ]
    return found


def test_no_action_of_the_policy_shows_a_secret() -> None:
    allowed = [
        action
        for statement in statements()
        if statement["Effect"] == "Allow"
        for action in ([statement["Action"]] if isinstance(statement["Action"], str) else statement["Action"])
    ]
    assert not any("NotAction" in statement or "NotResource" in statement for statement in statements())
    assert set(allowed) == set(SHOWN)


# Documents


class Played:
    """Alice plays and bob has played, both on warm servers; with the secrets of that."""

    def __init__(self, world: MotoWorld) -> None:
        self.study = StudyOnMoto(world, warmServers=1)
        self._told: set[str] = set()
        alice, bob = Person(self.study, "R_alice"), Person(self.study, "R_bob")
        for person in (bob, alice):
            person.to_the_game()
            self.study.deliver()
            self._look(world)
            if person is bob:
                bob.play()
                bob.answer(fun="5")
                self.study.deliver()
        kept = self.study.world.platform.documents.get(KEY)
        assert kept
        (project,) = self.study.stored("project_master_list.json")["projects"]
        self.secrets = {
            "the secret": self.study.stored(KEY)["secret"],
            "what signs tickets and links": derived.project_secret(kept.body, project),
            "alice's token": derived.token(kept.body, self.study.record("R_alice")),
            **{f"what a server was told, {n}": told for n, told in enumerate(sorted(self._told))},
        }

    def _look(self, world: MotoWorld) -> None:
        for arn in world.task_arns():
            environment = world.task(arn).overrides["containerOverrides"][0]["environment"]
            self._told |= {one["value"] for one in environment if one["name"] in {"TOKEN", "CREDENTIAL"}}

    def shown(self, judge: Judge, who: str = POLICY) -> list[str]:
        """Return the documents that show a secret to a holder of this policy or role."""
        found = []
        for entry in self.study.world.platform.documents.list(""):
            arn = f"arn:aws:s3:::{self.study.world.env['BUCKET']}/{entry.key}"
            document = self.study.world.platform.documents.get(entry.key)
            assert document
            if judge.may(who, Ask("s3:GetObject", arn)):
                found += [f"{entry.key}: {what}" for what, it in self.secrets.items() if it.encode() in document.body]
        return found


def test_no_document_that_researchers_may_read_holds_a_secret(world: MotoWorld) -> None:
    played = Played(world)
    assert len(set(played.secrets.values())) >= 6
    assert all(len(secret) >= 48 for secret in played.secrets.values())
    judge = Judge(account_of(world))
    bucket = f"arn:aws:s3:::{world.env['BUCKET']}"
    for key in ("project_master_list.json", f"_servers/{ids.server_label(PROJECT, 'R_alice')}.json"):
        assert judge.may(POLICY, Ask("s3:GetObject", f"{bucket}/{key}")), "status and cost read it"
    assert played.shown(judge) == []
    assert [played.shown(judge, role) for role in LENT] == [[]]


def test_a_policy_that_shows_the_secret_is_noticed(world: MotoWorld) -> None:
    more = copy.deepcopy(cfn.template())
    for statement in statements(more):
        if statement["Action"] == "s3:GetObject":
            statement["Resource"] = {"Fn::Sub": "${Bucket.Arn}/*"}
    assert Played(world).shown(Judge(account_of(world, more))) == [f"{KEY}: the secret"]


def test_answers_of_the_function_that_researchers_may_invoke_hold_no_secret(world: MotoWorld) -> None:
    played = Played(world)
    registration = {"id": PROJECT, "steps": []}
    asked: list[dict[str, Any]] = [
        {"links": {"projectId": PROJECT, "userIds": ["R_alice", "R_new"]}},
        {"links": {"projectId": PROJECT, "userIds": [KEY]}},
        {"links": {"projectId": "../_secret.json", "userIds": []}},
        {"project": registration},
        {"project": {**registration, "salt": "mine"}},
        {},
    ]
    for event in asked:
        answer = repr(update_project_master_list.handler(event, None))
        assert [what for what, secret in played.secrets.items() if secret in answer] == []


# Other ways to a secret


BUCKET = "arn:aws:s3:::the-bucket"
HERE = "us-east-1:123456789012"
SECRET_KEYS = (
    KEY,
    "SSL/privkey.pem",
    "SSL/servers.example.org/privkey.pem",
    "SSL/account.json",
    "_slots/p.json",
    "_warm/p.json",
)
KEY_OF_MODEL = f"arn:aws:ssm:{HERE}:parameter/hippodrome/hippodrome/LLM_KEY"
CLUSTER = {"ecs:cluster": f"arn:aws:ecs:{HERE}:cluster/hippodrome"}
TASK = f"arn:aws:ecs:{HERE}:task/hippodrome/0123456789abcdef"
FUNCTIONS = [*cfn.functions()]
ROLES = [*cfn.resources("AWS::IAM::Role")]


def ways() -> Iterator[Ask]:
    """Each way to a token, a secret or a credential that AWS offers to who may use it."""
    for key in SECRET_KEYS:
        for action in ("s3:GetObject", "s3:GetObjectVersion", "s3:PutObject", "s3:DeleteObject", "s3:GetObjectTorrent"):
            yield Ask(action, f"{BUCKET}/{key}")
    for key in ("project_master_list.json", f"_servers/{'s' * 21}.json", "p/users/u/participant.json"):
        yield Ask("s3:PutObject", f"{BUCKET}/{key}")
    for action in (
        "s3:ListBucketVersions", "s3:PutBucketPolicy", "s3:PutReplicationConfiguration", "s3:PutInventoryConfiguration",
        "s3:PutBucketNotification", "s3:PutBucketAcl", "s3:PutBucketVersioning", "s3:PutLifecycleConfiguration",
    ):  # fmt: skip
        yield Ask(action, BUCKET)
    for action in ("ecs:DescribeTasks", "ecs:ExecuteCommand", "ecs:StopTask", "ecs:GetTaskProtection"):
        yield Ask(action, TASK, CLUSTER)
        yield Ask(
            action,
            f"arn:aws:ecs:{HERE}:task/{'s' * 21}-1/0123456789abcdef",
            {"ecs:cluster": f"arn:aws:ecs:{HERE}:cluster/{'s' * 21}-1"},
        )
    yield Ask("ecs:RunTask", f"arn:aws:ecs:{HERE}:task-definition/hippodrome-p:1", CLUSTER)
    yield Ask("ecs:StartTask", f"arn:aws:ecs:{HERE}:task-definition/hippodrome-p:1", CLUSTER)
    yield Ask("ecs:CreateService", f"arn:aws:ecs:{HERE}:service/hippodrome/mine", CLUSTER)
    for name in FUNCTIONS:
        arn = f"arn:aws:lambda:{HERE}:function:hippodrome-{name}"
        for action in (
            "lambda:GetFunction", "lambda:GetFunctionConfiguration", "lambda:UpdateFunctionCode", "lambda:UpdateFunctionConfiguration",
            "lambda:PublishVersion", "lambda:AddPermission", "lambda:PutFunctionEventInvokeConfig",
        ):  # fmt: skip
            yield Ask(action, arn)
        if name != "update_project_master_list":
            yield Ask("lambda:InvokeFunction", arn)
    yield Ask("lambda:CreateEventSourceMapping", "*")
    yield Ask("lambda:CreateFunction", f"arn:aws:lambda:{HERE}:function:mine")
    account = cfn.ReferenceValues()
    for queue in cfn.resources("AWS::SQS::Queue"):
        for action in ("sqs:ReceiveMessage", "sqs:SetQueueAttributes", "sqs:StartMessageMoveTask", "sqs:AddPermission"):
            yield Ask(action, account.attribute(queue, "Arn"))
    for topic in ("start-server", "stop-server", "alarms"):
        for action in ("sns:Subscribe", "sns:Publish", "sns:SetTopicAttributes", "sns:AddPermission"):
            yield Ask(action, f"arn:aws:sns:{HERE}:hippodrome-{topic}")
    yield Ask("events:PutRule", f"arn:aws:events:{HERE}:rule/mine")  # ECS events carry what a task is told
    yield Ask("events:PutTargets", f"arn:aws:events:{HERE}:rule/hippodrome-task-changed")
    yield Ask("pipes:CreatePipe", f"arn:aws:pipes:{HERE}:pipe/mine")
    yield Ask("scheduler:GetSchedule", f"arn:aws:scheduler:{HERE}:schedule/hippodrome/{'s' * 21}-1")
    yield Ask("cloudtrail:LookupEvents", "*")
    stack = f"arn:aws:cloudformation:{HERE}:stack/hippodrome/1"
    for action in ("UpdateStack", "CreateChangeSet", "ExecuteChangeSet", "SetStackPolicy", "GetTemplate"):
        yield Ask(f"cloudformation:{action}", stack)
    for role in ROLES:
        arn = f"arn:aws:iam::123456789012:role/hippodrome-{role}"
        for action in ("sts:AssumeRole", "iam:UpdateAssumeRolePolicy", "iam:PutRolePolicy", "iam:AttachRolePolicy"):
            yield Ask(action, arn)
        for service in (
            "ecs-tasks.amazonaws.com",
            "lambda.amazonaws.com",
            "scheduler.amazonaws.com",
        ):
            if (role, service) != ("TaskExecutionRole", "ecs-tasks.amazonaws.com"):
                yield Ask("iam:PassRole", arn, {"iam:PassedToService": service})
    for action in (
        "ssm:GetParameter",
        "ssm:GetParametersByPath",
        "ssm:GetParameterHistory",
        "ssm:LabelParameterVersion",
    ):
        yield Ask(action, KEY_OF_MODEL)
    yield Ask("ssm:GetParameters", f"arn:aws:ssm:{HERE}:parameter/hippodrome/another/LLM_KEY")
    yield Ask("kms:Decrypt", f"arn:aws:kms:{HERE}:key/of-the-account")
    yield Ask("iam:CreatePolicyVersion", "arn:aws:iam::123456789012:policy/hippodrome-ResearcherPolicy")
    yield Ask("logs:PutSubscriptionFilter", f"arn:aws:logs:{HERE}:log-group:/hippodrome/hippodrome/trial")


WAYS = [*ways()]


@pytest.fixture
def judge(judged: None) -> Judge:
    texts = {"RootDomain": "example.org", "HostedZoneId": "Z1"}
    return Judge(cfn.ReferenceValues(parameters=texts, known={"Bucket": "the-bucket"}))


def test_the_policy_allows_no_other_way_to_a_secret(judge: Judge) -> None:
    assert len(WAYS) > 200
    assert [ask for ask in WAYS if judge.may(POLICY, ask)] == []


@pytest.mark.parametrize(
    "key",
    [  # whose names hold /steps/, as those of pages do
        "p/users/steps/answers/3.json",
        "p/users/steps/participant.json",
        "p/users/u/trials/steps/3-trial.jsonl.gz",
        "_servers/steps/x.json",
        "_slots/steps/x.json",
        "_warm/steps/x.json",
        "SSL/steps/x.pem",
    ],
)
def test_researchers_may_write_pages_and_nothing_with_a_similar_key(judge: Judge, key: str) -> None:
    for action in ("s3:PutObject", "s3:DeleteObject"):
        assert not judge.may(POLICY, Ask(action, f"{BUCKET}/{key}"))
        assert judge.may(POLICY, Ask(action, f"{BUCKET}/p/steps/consent.html"))
        assert judge.may(POLICY, Ask(action, f"{BUCKET}/users/steps/consent.html"))


@pytest.mark.parametrize("role", LENT)
def test_the_roles_of_containers_allow_no_way_to_a_secret(judge: Judge, role: str) -> None:
    assert [ask for ask in WAYS if judge.may(role, ask)] == []


def test_the_key_of_a_language_model_is_read_by_fargate_alone(judge: Judge) -> None:
    read = Ask("ssm:GetParameters", KEY_OF_MODEL)
    assert judge.may("TaskExecutionRole", read)
    assert not judge.may(POLICY, read)
    assert judge.who_may(read) == frozenset(), "no function"
    for action in ("ssm:PutParameter", "ssm:DeleteParameter"):
        assert judge.may(POLICY, Ask(action, KEY_OF_MODEL))
        assert not judge.may("TaskExecutionRole", Ask(action, KEY_OF_MODEL))
        for other in ("hippodrome/another/LLM_KEY", "hippodrome/hippodrome/OTHER", "LLM_KEY"):
            assert not judge.may(POLICY, Ask(action, f"arn:aws:ssm:{HERE}:parameter/{other}"))


@pytest.mark.parametrize("role", LENT)
def test_the_roles_of_containers_read_no_documents(judge: Judge, role: str) -> None:
    for key in (
        "project_master_list.json",
        "_servers/s.json",
        "p/users/u/participant.json",
        "p/users/u/answers/1.json",
    ):
        assert not judge.may(role, Ask("s3:GetObject", f"{BUCKET}/{key}"))


def _anything(statement: dict[str, Any]) -> None:
    statement["Action"] = (
        [statement["Action"], "*"] if isinstance(statement["Action"], str) else [*statement["Action"], "*"]
    )


def _describes_tasks(statement: dict[str, Any]) -> None:
    statement["Action"] = ["ecs:ListTasks", "ecs:DescribeTasks"]


@pytest.mark.parametrize(
    ("at", "change", "opens"),
    [
        ("ecs:ListTasks", _describes_tasks, {"ecs:DescribeTasks"}),
        ("sqs:GetQueueAttributes", _anything, {"sqs:ReceiveMessage", "sqs:SetQueueAttributes"}),
        ("lambda:InvokeFunction", _anything, {"lambda:GetFunctionConfiguration", "lambda:UpdateFunctionCode"}),
    ],
)
def test_a_policy_that_opens_a_way_is_noticed(
    judged: None, at: str, change: Callable[[dict[str, Any]], None], opens: set[str]
) -> None:
    more = copy.deepcopy(cfn.template())
    for statement in statements(more):
        if at in statement["Action"]:
            change(statement)
    texts = {"RootDomain": "example.org", "HostedZoneId": "Z1"}
    wider = Judge(cfn.ReferenceValues(parameters=texts, known={"Bucket": "the-bucket"}, of=more))
    assert opens <= {ask.action for ask in WAYS if wider.may(POLICY, ask)}
