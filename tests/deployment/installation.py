"""An installation of Hippodrome in an account on moto, for tests of the commands.

`Installed` is a `MotoWorld` with a stack beside it. Gap: moto's CloudFormation skips ApiGatewayV2, Scheduler and SNS
subscriptions, so the stack is made from a tiny template: its outputs are those of `infra/template.yml` and lead to what
`MotoWorld` made; of its resources only those are there that commands look for by `ListStackResources`.

In this process, commands are run by `run(...)`. `served()` puts moto's server before the same account, for commands
that run as processes of their own.
"""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import pytest
from moto.cloudformation.models import cloudformation_backends
from moto.cloudwatch.models import cloudwatch_backends
from moto.ecr.models import ecr_backends
from moto.s3.models import s3_backends
from moto.sns.models import sns_backends

from hippodrome.cli import main
from hippodrome.control.model import ids, server, warm_pool
from hippodrome.control.model.messages import StartServer, parse_task_changed
from hippodrome.control.model.participant import Participant, participant_key
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.model.warm_pool import Pool
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import KEY
from hippodrome.deployment.aws.account import Account
from hippodrome.protocol.answer import Answer
from hippodrome.protocol.keys import answer_key
from testing import processes
from testing.aws_events import ACCOUNT
from testing.botocore_sessions import botocore_session
from testing.moto_world import MotoWorld
from testing.servers import Servers
from testing.studies import INSTALLATION_SECRET, study

ROOT = Path(__file__).resolve().parents[2]
STACK = "hippodrome"
KEYS = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_REGION": "us-east-1"}


@dataclass
class CommandResult:
    """A command that has ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The JSON on stdout; anything else there is an error."""
        return json.loads(self.out)


class Installed(MotoWorld):
    """`MotoWorld` and the stack `hippodrome` over it."""

    def __init__(self, **outputs: str) -> None:
        super().__init__()
        self._changes = outputs
        self.server = ""

    def _build(self) -> None:
        """As in `MotoWorld`, as moto's own objects."""
        super()._build()
        self._secure_bucket()
        ecr = ecr_backends[ACCOUNT][self.region]
        self.repository = ecr.create_repository(STACK, ACCOUNT, {}, {}, "MUTABLE", []).uri
        self.alarm_topic = str(sns_backends[ACCOUNT][self.region].create_topic("hippodrome-alarms").arn)
        cloudwatch_backends[ACCOUNT][self.region].put_metric_alarm(
            name="hippodrome-dead-letters",
            alarm_actions=[self.alarm_topic],
            namespace="AWS/SQS",
            metric_name="ApproximateNumberOfMessagesVisible",
            statistic="Maximum",
            period=60,
            evaluation_periods=1,
            threshold=0,
            comparison_operator="GreaterThanThreshold",
            description=None,  # type: ignore[arg-type]
            dimensions=[],
        )
        self.stack(self.template())

    def _secure_bucket(self) -> None:
        """Give the bucket the settings of the template, without the policy.

        Gap: moto ignores the conditions of a bucket policy, so the policy that requires TLS would refuse every request.
        """
        s3, bucket = s3_backends[ACCOUNT]["aws"], self.env["BUCKET"]
        names = ["BlockPublicAcls", "IgnorePublicAcls", "BlockPublicPolicy", "RestrictPublicBuckets"]
        s3.put_public_access_block(bucket, dict.fromkeys(names, "true"))
        s3.put_bucket_versioning(bucket, "Enabled")
        s3.put_bucket_encryption(bucket, {"Rule": {"ApplyServerSideEncryptionByDefault": {"SSEAlgorithm": "AES256"}}})

    # -- the stack ------------------------------------------------------------------------------------------------

    @property
    def outputs(self) -> dict[str, str]:
        """The stack's outputs under their names in `infra/template.yml`."""
        return {
            "Site": f"https://study.{self.root_domain}",
            "Bucket": self.env["BUCKET"],
            "HostedZoneId": self.env["HOSTED_ZONE_ID"],
            "RootDomain": self.root_domain,
            "ServersHost": self.env["SERVERS_HOST"],
            "MaxRuntime": self.env["MAX_RUNTIME"],
            "ServerPort": "443",
            "Cluster": self.env["CLUSTER"],
            "Subnets": self.env["SUBNET"],
            "SecurityGroup": self.env["SECURITY_GROUP"],
            "StartServerTopic": self.env["START_SERVER_TOPIC_ARN"],
            "StopServerTopic": self.env["STOP_SERVER_TOPIC_ARN"],
            "TaskQueue": self.env["TASK_QUEUE_URL"],
            "ScheduleGroup": self.env["SCHEDULE_GROUP"],
            "ScheduleRole": self.env["SCHEDULE_ROLE_ARN"],
            "Repository": self.repository,
            "TaskExecutionRole": f"arn:aws:iam::{ACCOUNT}:role/hippodrome-task-execution",
            "TrialLogGroup": f"/hippodrome/{STACK}/trial",
            "RegisterFunction": f"{STACK}-update_project_master_list",
            "ResearcherPolicy": f"arn:aws:iam::{ACCOUNT}:policy/hippodrome-researcher",
            "Dashboard": "https://console.aws.amazon.com/cloudwatch/home#dashboards:name=hippodrome",
            "Alarms": self.alarm_topic,
            **self._changes,
        }

    def template(self) -> dict[str, Any]:
        """Return the tiny template: outputs, and a queue with its dead letters."""
        queue = {"maxReceiveCount": 5, "deadLetterTargetArn": {"Fn::GetAtt": ["StartServerDeadLetters", "Arn"]}}
        return {
            "AWSTemplateFormatVersion": "2010-09-09",
            "Resources": {
                "StartServerDeadLetters": {
                    "Type": "AWS::SQS::Queue",
                    "Properties": {"QueueName": "hippodrome-start-dead-letters"},
                },
                "StartServerQueue": {
                    "Type": "AWS::SQS::Queue",
                    "Properties": {"QueueName": "hippodrome-start-server-queue", "RedrivePolicy": queue},
                },
            },
            "Outputs": {name: {"Value": value} for name, value in self.outputs.items()},
        }

    def stack(self, template: dict[str, Any], name: str = STACK) -> None:
        cloudformation_backends[ACCOUNT][self.region].create_stack(
            name, json.dumps(template), {}, notification_arns=[], tags={"hippodrome:stack": name}
        )

    def change(self, **outputs: str) -> None:
        """Change outputs of the stack."""
        self._changes |= outputs
        self.client("cloudformation").update_stack(StackName=STACK, TemplateBody=json.dumps(self.template()))

    def stack_status(self, status: str, name: str = STACK) -> None:
        """Set the status of the stack."""
        for stack in cloudformation_backends[ACCOUNT][self.region].stacks.values():
            if stack.name == name:
                stack.status = status

    # -- participants and servers ------------------------------------------------------------------------------------------

    def put(self, key: str, body: bytes) -> None:
        self.client("s3").put_object(Bucket=self.env["BUCKET"], Key=key, Body=body)

    def get(self, key: str) -> bytes:
        return bytes(self.client("s3").get_object(Bucket=self.env["BUCKET"], Key=key)["Body"].read())

    def keys(self, prefix: str = "") -> list[str]:
        pages = self.client("s3").get_paginator("list_objects_v2").paginate(Bucket=self.env["BUCKET"], Prefix=prefix)
        return [line["Key"] for page in pages for line in page.get("Contents", ())]

    def register(self, *projects: Project) -> None:
        """Write these projects into the master list, without any check, and the installation's secret."""
        self.put(KEY, to_json(INSTALLATION_SECRET))
        self.put(MASTER_LIST, to_json(MasterList(sorted(projects or [study()], key=lambda p: p.id))))

    def participant(
        self, user: str, *, answered: int = 0, project: Project | None = None, recordings: int = 0, **link: str
    ) -> None:
        """Store a participant who has answered the first `answered` steps."""
        project = project or study()
        now = datetime.now(UTC)
        arrival = Participant(project.id, user, now, project.group(user), "CODE", link)
        self.put(participant_key(project.id, user), to_json(arrival))
        for step in project.steps[:answered]:
            answers: dict[str, Any] = (
                {"score": 12, "episodes": 1} if step.type.on_server else {"age": "33", "pet": ["cat", "dog"]}
            )
            answer = Answer(step.key, project.file(user, step), project.group(user, step), now, answers)
            self.put(answer_key(project.id, user, step.key), msgspec.json.encode(answer))
        for number in range(1, recordings + 1):
            name = ids.server_name(ids.server_label(project.id, user), 1)
            body = gzip.compress(b'{"kind": "header", "v": 1}\n')
            self.put(f"{project.id}/users/{user}/trials/{name}/3-episode-{number:04}.jsonl.gz", body)

    def record(
        self, user: str, state: ServerState = ServerState.READY, project: Project | None = None, **changes: Any
    ) -> Server:
        """Store the record of a server that was requested ten minutes ago."""
        project = project or study()
        then = datetime.now(UTC) - timedelta(minutes=10)
        attempt = changes.pop("attempt", 1)
        settings = self.platform.settings
        made = server.new_attempt(project, user, attempt, nonce="secret-token", settings=settings, now=then)
        if state is not ServerState.STARTING:
            changes.setdefault("running", then + timedelta(seconds=40))
            changes.setdefault("host", "203.0.113.7")
            changes.setdefault("port", 5000)
        made = msgspec.structs.replace(made, state=state, **changes)
        self.put(server.key(made.label), to_json(made))
        return made

    def warm(self, project: Project, number: int) -> list[str]:
        """Start warm servers of a registered project, and make them ready. Returns their names."""
        servers, repository, before = Servers(self.platform), Repository(self.platform.documents), set(self.task_arns())
        now = datetime.now(UTC)
        new = Pool().with_new(project, number, now)
        for warm_server in new.warm_servers:
            servers.start(StartServer(project.id, warm_server))
        events = [parse_task_changed(self.task_event(arn, "RUNNING")) for arn in self.task_arns() if arn not in before]
        assert servers.tasks_changed([event for event in events if event]) == []
        ready = [
            repository.update(
                repository.server(ids.server_label(project.id, warm_server)), lambda r: server.ready(r, now)
            )
            for warm_server in new.warm_servers
        ]
        self.put(warm_pool.pool_key(project.id), to_json(new.with_ready(list(new.warm_servers))))
        return [stored.server.name for stored in ready if stored]

    # -- commands -------------------------------------------------------------------------------------------------

    def run(self, capsys: pytest.CaptureFixture[str], *arguments: str) -> CommandResult:
        """Run a command in this process with the arguments of its command line."""
        capsys.readouterr()
        with pytest.MonkeyPatch.context() as patch:
            for name, value in KEYS.items():
                patch.setenv(name, value)
            code = main(arguments)
        printed = capsys.readouterr()
        assert "Traceback" not in printed.err
        return CommandResult(code, printed.out, printed.err)

    @contextlib.contextmanager
    def served(self) -> Iterator[dict[str, str]]:
        """Put a real HTTP server on loopback before this account. Yields the environment for processes that use it."""
        from moto.server import ThreadedMotoServer

        server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
        server.start()
        assert server._server
        server._server.app = self.one_at_a_time(server._server.app)
        host, port = server.get_host_and_port()
        try:
            yield environment(f"http://{host}:{port}")
        finally:
            server.stop()


def environment(endpoint: str = "") -> dict[str, str]:
    """Return the environment of a command's process, without settings of the person who runs the tests."""
    kept = {name: os.environ[name] for name in ("PATH", "LANG", "LC_ALL", "TMPDIR") if name in os.environ}
    more = {"AWS_ENDPOINT_URL": endpoint} if endpoint else {}
    quiet = {
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    return {**kept, **KEYS, **quiet, **more, "PYTHONPATH": str(ROOT), "COLUMNS": "160", "PYTHONUTF8": "1"}


def process(env: dict[str, str], *arguments: str, folder: Path = ROOT, timeout: float = 90) -> CommandResult:
    """Run a command as a process of its own."""
    with tempfile.TemporaryFile("w+") as errors:
        ran = processes.start("hippodrome", arguments, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=errors)
        try:
            out, _ = ran.communicate(timeout=timeout)
        finally:
            ran.kill()
        errors.seek(0)
        err = errors.read()
    assert "Traceback" not in err, err
    assert ran.returncode is not None
    return CommandResult(ran.returncode, out, err)


def account_here() -> Account:
    """Open the account of moto, with the credentials of the environment."""
    return Account(botocore_session(), KEYS["AWS_REGION"])


@pytest.fixture
def access_keys(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the access keys of an administrator into the environment."""
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)


@pytest.fixture
def account(access_keys: None) -> Account:
    """Return the account as the commands open it."""
    return account_here()


@pytest.fixture
def installed() -> Iterator[Installed]:
    """Return a new installation."""
    with Installed() as world:
        yield world
