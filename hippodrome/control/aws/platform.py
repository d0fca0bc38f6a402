"""`AwsPlatform`: the ports on AWS, each created when it is first used.

Clients come from `botocore.session`, since boto3 would add its package and resources and nothing that the ports use.
CPU time above an empty Python, medians of 15 fresh processes in one run (botocore 1.44.5, Python 3.11): an S3 client
cost 253 ms with botocore and 319 ms with boto3, S3 and SNS 284 and 323 ms; ECS cost 300 ms, ECS and EC2 511 ms, so
`tasks` creates the EC2 client only for addresses.
"""

# ruff: noqa: PLC0415 - botocore and the ports are imported by the functions that use them, when they use them

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, TypeVar

from hippodrome.control.ports import Settings

if TYPE_CHECKING:
    from hippodrome.control.aws.bus import SnsBus
    from hippodrome.control.aws.challenges import Route53Challenges
    from hippodrome.control.aws.documents import S3Documents
    from hippodrome.control.aws.signer import S3Signer
    from hippodrome.control.aws.tasks import EcsTasks
    from hippodrome.control.aws.timers import SchedulerTimers
    from hippodrome.control.ports import Dns

CONNECT_TIMEOUT = 2  # seconds
READ_TIMEOUT = 5  # seconds; ECS and EC2 get twice as long
ATTEMPTS = 3  # attempts at a call, the first included, with botocore's backoff between them (at most 1 s, then 2 s)

MAX_THREADS = 16  # the most threads of a function that handles a batch

_SLOW_SERVICES = {"ecs", "ec2"}
T = TypeVar("T")


class AwsPlatform:
    """Implements `hippodrome.control.ports.Platform`.

    One client per service is created when first needed; several threads may use it. No call takes longer than
    `ATTEMPTS` times the connect and read timeouts, plus the backoff between: 24 s, for ECS and EC2 39 s.
    """

    def __init__(self, env: Mapping[str, str], session: Any = None, client_lock: threading.Lock | None = None) -> None:
        """Use the settings in `env`, the functions' environment variables, each of which is read when it is needed.

        `session`: a botocore session with the caller's credentials; by default those of the environment.
        `client_lock` is held while a client is created. Pass one if other code creates clients of the same session.
        """
        self._env = env
        self._given_session = session
        self._clients: dict[str, Any] = {}
        self._client_lock = client_lock or threading.Lock()

    @cached_property
    def settings(self) -> Settings:
        return Settings.from_env(self._env)

    @cached_property
    def documents(self) -> S3Documents:
        """The documents on S3. The variable `BUCKET` must be set."""
        from hippodrome.control.aws.documents import S3Documents

        return S3Documents(lambda: self._client("s3"), self._need("documents", "BUCKET"))

    @cached_property
    def signer(self) -> S3Signer:
        """The signer of `sign_requests`. The variable `BUCKET` must be set.

        It is no port: on one machine nothing is signed.
        """
        from hippodrome.control.aws.signer import S3Signer

        def credentials() -> Any:
            credentials = self._session.get_credentials()
            if credentials is None:
                raise RuntimeError("there are no AWS credentials to sign requests with; the function needs a role")
            return credentials.get_frozen_credentials()

        return S3Signer(lambda: self._client("s3"), credentials, self._need("signer", "BUCKET"))

    @cached_property
    def tasks(self) -> EcsTasks:
        """The servers on ECS.

        The variable `CLUSTER` must be set to list tasks; `SUBNET`, `SECURITY_GROUP` and `SIGN_URL` to run them.
        """
        from hippodrome.control.aws.tasks import EcsTasks

        return EcsTasks(lambda: self._client("ecs"), lambda: self._client("ec2"), partial(self._need, "tasks"))

    @cached_property
    def dns(self) -> Dns:
        """The DNS records on Route 53. To list them, the variable `ROOT_DOMAIN` must be set, too.

        Without the variable `HOSTED_ZONE_ID` servers have no names, and there are no records.
        """
        if not self._env.get("HOSTED_ZONE_ID", "").strip():
            from hippodrome.control.aws.no_dns import NoDns

            return NoDns()
        from hippodrome.control.aws.dns import Route53Dns

        host = self.settings.servers_host
        return Route53Dns(lambda: self._client("route53"), partial(self._need, "dns"), host)

    @cached_property
    def timers(self) -> SchedulerTimers:
        """The timers on EventBridge Scheduler.

        The variable `SCHEDULE_GROUP` must be set; `SCHEDULE_ROLE_ARN` and `STOP_SERVER_TOPIC_ARN` too to set a timer.
        """
        from hippodrome.control.aws.timers import SchedulerTimers

        return SchedulerTimers(lambda: self._client("scheduler"), partial(self._need, "timers"), self.now)

    @cached_property
    def bus(self) -> SnsBus:
        """The messages on SNS and SQS.

        To publish to a topic, the variable with its ARN must be set (`bus.TOPICS`); for `send_delayed`,
        `TASK_QUEUE_URL`.
        """
        from hippodrome.control.aws.bus import SnsBus

        return SnsBus(lambda: self._client("sns"), lambda: self._client("sqs"), partial(self._need, "bus"))

    @cached_property
    def challenges(self) -> Route53Challenges:
        """The TXT records of DNS-01 challenges. It is no port: one machine orders no certificate."""
        from hippodrome.control.aws.challenges import Route53Challenges

        return Route53Challenges(lambda: self._client("route53"), partial(self._need, "challenges"))

    def now(self) -> datetime:
        return datetime.now(UTC)

    def run_all(self, acts: Sequence[Callable[[], T]]) -> list[T]:
        """Call the functions on up to `MAX_THREADS` threads: the calls of a batch mostly wait for the network."""
        if len(acts) < 2:
            return [act() for act in acts]
        from concurrent.futures import ThreadPoolExecutor
        from contextvars import copy_context

        with ThreadPoolExecutor(min(MAX_THREADS, len(acts))) as pool:
            return [future.result() for future in [pool.submit(copy_context().run, act) for act in acts]]

    def _need(self, port: str, variable: str) -> str:
        """The value of an environment variable that this port needs. Raises RuntimeError if the variable is missing."""
        value = self._env.get(variable, "").strip()
        if not value:
            raise RuntimeError(f"the environment variable {variable} is missing; the port {port!r} needs it")
        return value

    @cached_property
    def _session(self) -> Any:
        if self._given_session is not None:
            return self._given_session
        import botocore.session

        return botocore.session.get_session()

    def _client(self, service: str) -> Any:
        """The client of an AWS service. Needs `AWS_REGION`, which Lambda sets (or `AWS_DEFAULT_REGION`)."""
        client = self._clients.get(service)
        if client is not None:
            return client
        with self._client_lock:  # creating a client is not thread-safe, using one is
            if service not in self._clients:
                self._clients[service] = self._create_client(service)
            return self._clients[service]

    def _create_client(self, service: str) -> Any:
        region = self._env.get("AWS_REGION") or self._env.get("AWS_DEFAULT_REGION")
        if not region:
            raise RuntimeError(f"the environment variable AWS_REGION is missing; the client of {service!r} needs it")
        session = self._session
        from botocore.config import Config

        config = Config(
            connect_timeout=CONNECT_TIMEOUT,
            max_pool_connections=MAX_THREADS,
            read_timeout=2 * READ_TIMEOUT if service in _SLOW_SERVICES else READ_TIMEOUT,
            retries={"mode": "standard", "total_max_attempts": ATTEMPTS},
        )
        return session.create_client(service, region_name=region, config=config)
