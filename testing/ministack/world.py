"""An AWS account on ministack, with the installation that `hippodrome deploy` makes in it.

The gaps between ministack and AWS are named here and in `emulator.py`, each beside its bridge (search for "Gap:").
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import ssl
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import boto3
import httpx
from botocore.config import Config

from testing import aws_events, ports, processes, template
from testing.certificates import authority

ROOT = Path(__file__).resolve().parents[2]
ACCOUNT = "123456789012"
REGION = "ca-central-1"
ROOT_KEYS = ("AKIAROOTROOTROOTROOT", "the root user's secret")
DOMAIN = "hippodrome.test"  # no name server knows a name in .test (RFC 6761)
T = TypeVar("T")

FUNCTIONS = tuple(sorted(template.functions()))


DATA = {"infra", "requirements", "steps"}
"""Folders that the commands need, and that are no packages."""


def find_venv() -> Path | None:
    """Return ministack's own virtual environment, MINISTACK_VENV or `.venv-ministack`; None if there is none."""
    venv = Path(os.environ.get("MINISTACK_VENV") or ROOT / ".venv-ministack")
    return venv if (venv / "bin" / "ministack").exists() else None


def fits(venv: Path) -> bool:
    """Return whether the environment has our version of Python, for which the zips are made."""
    ours = f"{sys.version_info.major}.{sys.version_info.minor}."
    return f"version = {ours}" in (venv / "pyvenv.cfg").read_text()


def until(look: Callable[[], T], condition: str, seconds: float = 60) -> T:
    """Call `look` until what it returns is true, and return that.

    Raises AssertionError, with the condition in words and what `look` returned last, after so many seconds.
    """
    deadline = time.monotonic() + seconds
    while not (found := look()):
        if time.monotonic() > deadline:
            raise AssertionError(f"not within {seconds} s: {condition}; the last look: {found!r}")
        time.sleep(0.25)
    return found


def _certificates(folder: Path) -> tuple[Path, Path, Path]:
    """Make an authority and a certificate for loopback.

    Return the files of the authority, the certificate and its key.
    """
    made = authority("ministack", days=1)
    files = folder / "ca.pem", folder / "tls.pem", folder / "tls.key"
    for file, content in zip(files, (made.certificate, *made.issue("localhost", "127.0.0.1")), strict=True):
        file.write_bytes(content)
    return files


@dataclass(frozen=True)
class CommandRun:
    """A command that has ended: its exit status, what it printed, and its duration."""

    code: int
    out: str
    err: str
    seconds: float


class MinistackWorld:
    """One account on ministack.

    `client` returns clients of root; `decisions` are ministack's about all other callers.
    """

    def __init__(self, venv: Path, home: Path) -> None:
        self.venv, self.home = venv, home
        self.log = home / "ministack.log"
        self._decisions = home / "decisions.jsonl"
        self._clients: dict[Any, Any] = {}
        self.source = home / "source"
        self.timings: dict[str, float] = {}

    # -- opening and closing

    def __enter__(self) -> MinistackWorld:
        self.port = ports.free()
        self.endpoint = f"https://127.0.0.1:{self.port}"
        self.ca, certificate, key = _certificates(self.home)
        self.tls = ssl.create_default_context(cafile=str(self.ca))
        scratch = self.home / "tmp"
        scratch.mkdir()
        # Functions inherit this environment, so it holds nothing else. Only TMPDIR is used on disk.
        env = {
            "PATH": os.environ.get("PATH", ""),
            "HOME": str(self.home),
            "TMPDIR": str(scratch),
            "AUTH": "true",
            "IOT_MTLS_ENABLED": "0",
            "SFTP_ENABLED": "0",
            "BIND_HOST": "127.0.0.1",
            "GATEWAY_PORT": str(self.port),
            "MINISTACK_ACCOUNT_ID": ACCOUNT,
            "MINISTACK_REGION": REGION,
            "AWS_ACCESS_KEY_ID": ROOT_KEYS[0],
            "AWS_SECRET_ACCESS_KEY": ROOT_KEYS[1],
            "USE_SSL": "1",  # buckets refuse requests without TLS
            "MINISTACK_SSL_CERT": str(certificate),
            "MINISTACK_SSL_KEY": str(key),
            "AWS_CA_BUNDLE": str(self.ca),
            "DECISIONS": str(self._decisions),
        }
        self._decisions.touch()
        with self.log.open("wb") as log:
            self._process = subprocess.Popen(
                [str(self.venv / "bin" / "python"), str(Path(__file__).with_name("emulator.py"))],
                env=env,
                stdin=subprocess.PIPE,  # the emulator ends when this does
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        try:
            until(self._healthy, "ministack answers")
            self.zone = self._create_zone()
            self._copy_source()
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)  # the group holds the emulator and its functions alone
        self._process.wait()
        if self._process.stdin:
            self._process.stdin.close()

    def _healthy(self) -> bool:
        if self._process.poll() is not None:
            raise AssertionError("ministack ended at once:\n" + self.log.read_text()[-3000:])
        try:
            return httpx.get(f"{self.endpoint}/_ministack/health", timeout=2, verify=self.tls).status_code == 200
        except httpx.TransportError:
            return False

    def _create_zone(self) -> str:
        made = self.client("route53").create_hosted_zone(Name=f"{DOMAIN}.", CallerReference="world")
        return str(made["HostedZone"]["Id"]).rpartition("/")[2]

    def _copy_source(self) -> None:
        """Copy the project, so that a test may change a function's code. The commands run in the copy."""
        skip = shutil.ignore_patterns("__pycache__", "*.pyc")
        for folder in ROOT.iterdir():
            package = (folder / "__init__.py").exists() and folder.name not in ("bench", "testing", "tests")
            if package or folder.name in DATA:
                shutil.copytree(folder, self.source / folder.name, ignore=skip)
        for name in ("agent.py", "config.yml", "pyproject.toml"):
            shutil.copy(ROOT / name, self.source / name)
        shutil.copy(ROOT / "testing/ministack/images.py", self.source)

    # -- callers

    def client(self, service: str, keys: Mapping[str, str] | None = None) -> Any:
        """Return a client of a service with the credentials in `keys` (named as STS and IAM name them), or with root's."""
        who = json.dumps(dict(keys), sort_keys=True, default=str) if keys else ""
        if (service, who) not in self._clients:
            self._clients[service, who] = boto3.client(
                service,
                region_name=REGION,
                endpoint_url=self.endpoint,
                verify=str(self.ca),
                aws_access_key_id=keys["AccessKeyId"] if keys else ROOT_KEYS[0],
                aws_secret_access_key=keys["SecretAccessKey"] if keys else ROOT_KEYS[1],
                aws_session_token=keys.get("SessionToken") if keys else None,
                config=Config(connect_timeout=5, read_timeout=60, retries={"total_max_attempts": 1}),
            )
        return self._clients[service, who]

    def user(self, name: str, policy: str) -> dict[str, str]:
        """Create an IAM user with this managed policy, and return its access key."""
        iam = self.client("iam")
        iam.create_user(UserName=name)
        iam.attach_user_policy(UserName=name, PolicyArn=policy)
        return dict(iam.create_access_key(UserName=name)["AccessKey"])

    def decisions(self, who: str = "", allowed: bool | None = None) -> list[dict[str, Any]]:
        """Return the evaluator's decisions so far about callers whose ARN contains `who`, and with this result if given."""
        found = [json.loads(line) for line in self._decisions.read_text().splitlines()]
        return [one for one in found if who in one["who"] and allowed in (None, one["allowed"])]

    def complaints(self) -> str:
        """Return the last refused calls and the last errors and warnings of functions and ministack, for a failed test."""
        lines = [f"refused: {one}" for one in self.decisions(allowed=False)[-20:]]
        logs = self.client("logs")
        for group in logs.describe_log_groups()["logGroups"]:
            for event in logs.filter_log_events(logGroupName=group["logGroupName"])["events"][-200:]:
                if re.search(r"ERROR|WARNING|Traceback|Error", event["message"]):
                    lines.append(f"{group['logGroupName']}: {event['message'][:600]}")
        trouble = re.compile(r"ERROR|WARNING|Traceback|Exception")
        lines += [line[:600] for line in self.log.read_text().splitlines()[-2000:] if trouble.search(line)]
        return "\n".join(lines[-60:])

    # -- commands

    def deploy(self, *arguments: str, keys: Mapping[str, str] | None = None, stack: str = "") -> CommandRun:
        """Run `hippodrome …` in the copy of the project, with these credentials or with root's."""
        env = {name: value for name, value in os.environ.items() if not name.startswith(("AWS_", "HIPPODROME_"))}
        env |= {
            "AWS_ENDPOINT_URL": self.endpoint,
            "AWS_CA_BUNDLE": str(self.ca),
            "AWS_REGION": REGION,
            "AWS_ACCESS_KEY_ID": keys["AccessKeyId"] if keys else ROOT_KEYS[0],
            "AWS_SECRET_ACCESS_KEY": keys["SecretAccessKey"] if keys else ROOT_KEYS[1],
            "AWS_EC2_METADATA_DISABLED": "true",
            "AWS_CONFIG_FILE": os.devnull,
            "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
            # Gap: functions run as processes of this machine, whatever architecture and Python they ask for.
            "HIPPODROME_TARGET": "here",
            "PYTHONDONTWRITEBYTECODE": "",  # write bytecode, for the next command
        }
        if stack:
            env["HIPPODROME_STACK"] = stack
        began = time.monotonic()
        with tempfile.TemporaryFile("w+") as errors:
            process = processes.start(
                "images", arguments, cwd=self.source, env=env, stdout=subprocess.PIPE, stderr=errors
            )
            try:
                out, _ = process.communicate(timeout=280)  # a busy machine takes its time; the tests may take 300 s
            finally:
                process.kill()
            seconds = time.monotonic() - began
            errors.seek(0)
            ran = CommandRun(process.returncode, out, errors.read(), seconds)
        self.timings[" ".join(arguments[:1])] = seconds
        return ran

    # -- resources

    def inventory(self) -> dict[str, list[str]]:
        """Return, by kind, all resources in the account that a stack, a command or a function of ours could have left."""
        found: dict[str, list[str]] = {}
        for kind, (service, operation, path, arguments) in LISTS.items():
            client = self.client(service)
            call = getattr(client, operation)
            pages = (
                client.get_paginator(operation).paginate(**arguments)
                if client.can_paginate(operation)
                else [call(**arguments)]
            )
            outer, _, inner = path.partition(".")
            found[kind] = sorted(str(item[inner] if inner else item) for page in pages for item in page.get(outer, []))
        records = self.client("route53").list_resource_record_sets(HostedZoneId=self.zone)["ResourceRecordSets"]
        found["names"] = sorted(f"{record['Name']} {record['Type']}" for record in records)
        # ECS's service-linked role belongs to the account, not to the stack: all users of ECS in the account need it.
        found["roles"] = [role for role in found["roles"] if not role.startswith("AWSServiceRoleFor")]
        return found


LISTS: dict[str, tuple[str, str, str, dict[str, Any]]] = {  # service, operation, path of the names, parameters
    "alarms": ("cloudwatch", "describe_alarms", "MetricAlarms.AlarmName", {}),
    "APIs": ("apigatewayv2", "get_apis", "Items.Name", {}),
    "buckets": ("s3", "list_buckets", "Buckets.Name", {}),
    "certificates": ("acm", "list_certificates", "CertificateSummaryList.DomainName", {}),
    "clusters": ("ecs", "list_clusters", "clusterArns", {}),
    "dashboards": ("cloudwatch", "list_dashboards", "DashboardEntries.DashboardName", {}),
    "domain names": ("apigatewayv2", "get_domain_names", "Items.DomainName", {}),
    "event source mappings": ("lambda", "list_event_source_mappings", "EventSourceMappings.EventSourceArn", {}),
    "functions": ("lambda", "list_functions", "Functions.FunctionName", {}),
    "gateways": ("ec2", "describe_internet_gateways", "InternetGateways.InternetGatewayId", {}),
    "images": ("ecr", "describe_repositories", "repositories.repositoryName", {}),
    "log groups": ("logs", "describe_log_groups", "logGroups.logGroupName", {}),
    "policies": ("iam", "list_policies", "Policies.PolicyName", {"Scope": "Local"}),
    "queues": ("sqs", "list_queues", "QueueUrls", {}),
    "roles": ("iam", "list_roles", "Roles.RoleName", {}),
    "route tables": ("ec2", "describe_route_tables", "RouteTables.RouteTableId", {}),
    "rules": ("events", "list_rules", "Rules.Name", {}),
    "schedule groups": ("scheduler", "list_schedule_groups", "ScheduleGroups.Name", {}),
    "schedules": ("scheduler", "list_schedules", "Schedules.Name", {}),
    "security groups": ("ec2", "describe_security_groups", "SecurityGroups.GroupId", {}),
    "stacks": (
        "cloudformation",
        "list_stacks",
        "StackSummaries.StackName",
        {"StackStatusFilter": ["CREATE_COMPLETE", "UPDATE_COMPLETE", "ROLLBACK_COMPLETE", "DELETE_FAILED"]},
    ),
    "subnets": ("ec2", "describe_subnets", "Subnets.SubnetId", {}),
    "subscriptions": ("sns", "list_subscriptions", "Subscriptions.Endpoint", {}),
    "task definitions": ("ecs", "list_task_definitions", "taskDefinitionArns", {}),
    "topics": ("sns", "list_topics", "Topics.TopicArn", {}),
    "VPCs": ("ec2", "describe_vpcs", "Vpcs.VpcId", {}),
}


class MinistackInstallation:
    """A stack of Hippodrome in a world."""

    def __init__(self, world: MinistackWorld, stack: str = "hippodrome") -> None:
        self.world, self.stack = world, stack
        described = world.client("cloudformation").describe_stacks(StackName=stack)["Stacks"][0]
        self.status = described["StackStatus"]
        self.outputs = {one["OutputKey"]: one["OutputValue"] for one in described.get("Outputs", [])}
        self.bucket = self.outputs.get("Bucket", "")
        self.cluster = self.outputs.get("Cluster", "")

    def function(self, name: str) -> str:
        """Return the full name of a function."""
        return f"{self.stack}-{name}"

    def invoke(self, name: str, event: Any) -> Any:
        """Invoke a function as root, and return its answer. Raises AssertionError if the function fails."""
        answer = self.world.client("lambda").invoke(FunctionName=self.function(name), Payload=json.dumps(event))
        body = json.loads(answer["Payload"].read())
        assert "FunctionError" not in answer, body
        return body

    # -- S3

    def put(self, key: str, body: bytes) -> None:
        self.world.client("s3").put_object(Bucket=self.bucket, Key=key, Body=body)

    def stored(self, key: str) -> Any:
        """Return the JSON of a document; None if there is none."""
        s3 = self.world.client("s3")
        try:
            return json.loads(s3.get_object(Bucket=self.bucket, Key=key)["Body"].read())
        except s3.exceptions.NoSuchKey:
            return None

    # -- queues

    def queue(self, function: str, dead: bool = False) -> str:
        """Return the URL of the queue that feeds this function; with `dead`, that of its dead-letter queue."""
        event_sources = self.world.client("lambda").list_event_source_mappings(FunctionName=self.function(function))
        name = event_sources["EventSourceMappings"][0]["EventSourceArn"].rpartition(":")[2]
        sqs = self.world.client("sqs")
        url = str(sqs.get_queue_url(QueueName=name)["QueueUrl"])
        if not dead:
            return url
        policy = sqs.get_queue_attributes(QueueUrl=url, AttributeNames=["RedrivePolicy"])["Attributes"]["RedrivePolicy"]
        target = json.loads(policy)["deadLetterTargetArn"].rpartition(":")[2]
        return str(sqs.get_queue_url(QueueName=target)["QueueUrl"])

    def waiting(self, url: str) -> int:
        """Return how many messages a queue holds, visible or not."""
        names = ["ApproximateNumberOfMessages", "ApproximateNumberOfMessagesNotVisible"]
        found = self.world.client("sqs").get_queue_attributes(QueueUrl=url, AttributeNames=names)["Attributes"]
        return sum(int(found[name]) for name in names)

    # -- servers

    def tasks(self, status: str = "RUNNING") -> dict[str, dict[str, Any]]:
        """Return the cluster's tasks with this desired status, by `startedBy`.

        Raises AssertionError if two share one.
        """
        ecs = self.world.client("ecs")
        arns = ecs.list_tasks(cluster=self.cluster, desiredStatus=status)["taskArns"]
        found = ecs.describe_tasks(cluster=self.cluster, tasks=arns)["tasks"] if arns else []
        by_name = {task.get("startedBy", ""): task for task in found}
        assert len(by_name) == len(found), "two tasks for one server"
        return by_name

    def timers(self) -> list[str]:
        """Return the names of the servers' schedules."""
        group = self.outputs["ScheduleGroup"]
        found = self.world.client("scheduler").list_schedules(GroupName=group)["Schedules"]
        return [schedule["Name"] for schedule in found]

    def names(self) -> dict[str, str]:
        """Return, by name, the addresses of servers' A records."""
        zone = self.world.zone
        found = self.world.client("route53").list_resource_record_sets(HostedZoneId=zone)["ResourceRecordSets"]
        return {
            record["Name"].rstrip("."): record["ResourceRecords"][0]["Value"]
            for record in found
            if record["Type"] == "A" and re.match(r"s[a-z2-7]{20}-\d+\.", record["Name"])
        }

    def runs(self, task: Mapping[str, Any]) -> str:
        """Send the event that the task runs, and return its public address.

        Gap: ministack emits no ECS events and gives tasks no network interface. Bridge: an interface with an elastic
        address; and root puts the event on the bus in the form of ECS (`emulator.py` lets root use the source
        `aws.ecs`), so that it takes its way through the template's own rule and queue, with their policies.
        """
        ec2 = self.world.client("ec2")
        subnet = self.outputs["Subnets"].split(",")[0]
        interface = ec2.create_network_interface(SubnetId=subnet, Groups=[self.outputs["SecurityGroup"]])
        interface_id = interface["NetworkInterface"]["NetworkInterfaceId"]
        address = ec2.allocate_address(Domain="vpc")
        ec2.associate_address(AllocationId=address["AllocationId"], NetworkInterfaceId=interface_id)
        self._tell(task, "RUNNING", interface_id)
        return str(address["PublicIp"])

    def ended(self, task: Mapping[str, Any], stop_code: str = "UserInitiated", exit_code: int | None = 0) -> None:
        """Send the event that the task has stopped. It names a network interface that does not exist, as ECS's may."""
        self._tell(task, "STOPPED", "eni-gone", stop_code=stop_code, exit_code=exit_code)

    def _tell(self, task: Mapping[str, Any], status: str, interface: str, **more: Any) -> None:
        event = aws_events.ecs_event(
            region=REGION,
            arn=task["taskArn"],
            cluster_arn=task["clusterArn"],
            definition=task["taskDefinitionArn"],
            status=status,
            desired="STOPPED" if status == "STOPPED" else "RUNNING",
            started_by=task["startedBy"],
            capacity_provider=task.get("capacityProviderName"),
            overrides=task["overrides"],
            subnet=self.outputs["Subnets"].split(",")[0],
            interface=interface,
            private_ip="10.0.1.23",
            time=datetime.now(UTC),
            **more,
        )
        entry = {
            "Source": "aws.ecs",
            "DetailType": event["detail-type"],
            "Detail": json.dumps(event["detail"]),
            "Resources": event["resources"],
        }
        answer = self.world.client("events").put_events(Entries=[entry])
        assert answer["FailedEntryCount"] == 0, answer

    def remove_interfaces(self) -> None:
        """Remove the interfaces and addresses that `runs` has made. On AWS they go with the task."""
        ec2 = self.world.client("ec2")
        for address in ec2.describe_addresses()["Addresses"]:
            ec2.disassociate_address(AssociationId=address["AssociationId"])
            ec2.release_address(AllocationId=address["AllocationId"])
        for interface in ec2.describe_network_interfaces()["NetworkInterfaces"]:
            ec2.delete_network_interface(NetworkInterfaceId=interface["NetworkInterfaceId"])

    # -- the site

    @contextlib.contextmanager
    def browser(self) -> Iterator[httpx.Client]:
        """Give an HTTP client for the participants' site, the custom domain of the HTTP API, within the block."""
        site = httpx.URL(self.outputs["Site"])
        headers = {"Host": site.host, "Accept": "text/html"}
        with httpx.Client(base_url=self.world.endpoint, headers=headers, verify=self.world.tls, timeout=60) as client:
            yield client
