"""The AWS account that the commands work in, and the installation of Hippodrome they find there."""

from __future__ import annotations

import os
import shlex
import threading
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import boto3
import botocore.exceptions
import botocore.session
from botocore.config import Config

from hippodrome.console.problem import Problem
from hippodrome.control.aws import AwsPlatform, errors
from hippodrome.control.certificates.rules import Location, location
from hippodrome.control.ports import Settings
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.resource_names import STACK, TAG

_OUR_PARAMETERS = {"RootDomain", "HostedZoneId", "SiteHost", "CodeBucket"}  # parameters of infra/template.yml

_NO_REGION = (
    "No AWS region is set.",
    "Set it: `export AWS_REGION=ca-central-1`, for instance; or name one with --region.",
)
_NO_CREDENTIALS = (
    "There are no AWS credentials on this machine.",
    "Run `aws configure` or `aws sso login`, or set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY.",
)

_CONFIG = Config(connect_timeout=5, read_timeout=60, retries={"mode": "standard", "total_max_attempts": 5})
_FAIL_FAST = _CONFIG.merge(Config(connect_timeout=2, read_timeout=5, retries={"total_max_attempts": 1}))


class Account:
    """An AWS account in one region, with the credentials that boto3 finds (environment, profile, SSO)."""

    def __init__(self, core: botocore.session.Session, region: str) -> None:
        """`core` is the botocore session, which has the credentials."""
        self._core = core
        self._session = boto3.Session(botocore_session=core, region_name=region)
        self.region = region
        self._clients: dict[tuple[str, str], Any] = {}
        self._making = threading.Lock()  # making a client is not thread-safe, using one is

    def client(self, service: str, region: str | None = None) -> Any:
        """Return the boto3 client of a service, made once.

        `region`: another region, for the few services that need one.
        """
        key = (service, region or self.region)
        with self._making:
            if key not in self._clients:
                self._clients[key] = self._session.client(service, region_name=key[1], config=_CONFIG)
            return self._clients[key]

    def fail_fast_client(self, service: str) -> Any:
        """Return a new client, which tries once and gives up after seconds: for calls whose answer is only a hint."""
        with self._making:
            return self._session.client(service, region_name=self.region, config=_FAIL_FAST)

    def platform(self, installation: Installation) -> AwsPlatform:
        """Return the five ports in this installation, with this account's credentials (`--profile` included)."""
        return AwsPlatform(installation.env, self._core, self._making)

    @cached_property
    def identity(self) -> Mapping[str, str]:
        """Ask AWS whose the credentials are: `Account`, `Arn`. Raises botocore's errors (`deployment.core.explain`)."""
        return dict(self.client("sts").get_caller_identity())

    @property
    def id(self) -> str:
        """The account's twelve digits."""
        return self.identity["Account"]


def open_account(profile: str | None = None, region: str | None = None) -> Account:
    """Open the account to work in. Raises `Problem` if there are no credentials or no region."""
    try:
        core = botocore.session.Session(profile=profile)
        # botocore itself reads only AWS_DEFAULT_REGION; Lambda, the CLI and other SDKs read AWS_REGION first.
        region_name = region or os.environ.get("AWS_REGION") or core.get_config_variable("region")
        credentials = core.get_credentials()
    except botocore.exceptions.MissingDependencyException:  # awscrt, the only package that botocore can miss here
        raise _of_aws_login(profile or os.environ.get("AWS_PROFILE") or "default") from None
    except botocore.exceptions.ProfileNotFound as error:  # --profile or AWS_PROFILE names a profile that does not exist
        profiles = ", ".join(sorted(botocore.session.Session().available_profiles)) or "none"
        raise Problem(
            f"There is no AWS profile named {error.kwargs['profile']}.",
            f"Name another with --profile or AWS_PROFILE; profiles on this machine: {profiles}.",
        ) from None
    wrong = [] if region_name else [_NO_REGION]
    wrong += [_NO_CREDENTIALS] if credentials is None else []
    if wrong or not region_name:
        raise Problem(" ".join(text for text, _ in wrong), " ".join(advice for _, advice in wrong))
    return Account(core, region_name)


def _of_aws_login(profile: str) -> Problem:
    """Explain that only AWS's CLI can read the credentials of this profile of `aws login`, and how to use them here.

    botocore reads them only with a package in C (awscrt). AWS's command line prints them, and renews them: credentials
    are valid for 15 minutes, a login for 12 hours (AWS SDKs and Tools Reference Guide, "Login credentials
    provider" and "Process credentials").
    """
    hand_on = f"aws configure export-credentials --profile {shlex.quote(profile)} --format process"
    return Problem(
        f"The profile {profile} is of `aws login`, whose credentials cannot be read here.",
        "With these two lines, AWS's command line hands them on; the second is for each new terminal. Then run the "
        "same command again.",
        [
            f"aws configure set credential_process {shlex.quote(hand_on)} --profile hippodrome",
            "export AWS_PROFILE=hippodrome",
        ],
    )


_OF_DOMAIN = ("HostedZoneId", "RootDomain", "ServersHost")
"""The outputs that a stack without a domain lacks."""


@dataclass(frozen=True)
class Installation:
    """An existing stack of Hippodrome: its name, and its outputs under their names in `infra/template.yml`."""

    stack: str
    region: str
    status: str
    outputs: Mapping[str, str]
    parameters: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, account: Account, stack: Mapping[str, Any]) -> Installation:
        """Return the installation of a stack from DescribeStacks, in whatever state the stack is."""
        outputs = {output["OutputKey"]: output["OutputValue"] for output in stack.get("Outputs", ())}
        return cls(stack["StackName"], account.region, stack["StackStatus"], outputs, parameters_of(stack))

    def __getitem__(self, output: str) -> str:
        """Return an output of the stack; "" for one of a domain that it lacks. Raises `Problem` for any other."""
        if output in _OF_DOMAIN:
            return self.outputs.get(output, "")
        try:
            return self.outputs[output]
        except KeyError:
            raise Problem(
                f"The stack {self.stack} has no output {output}.",
                "Bring it up to date with `hippodrome deploy`.",
            ) from None

    @property
    def has_domain(self) -> bool:
        """Whether the site and servers have names; else servers have certificates for their addresses."""
        return bool(self["RootDomain"])

    @property
    def servers_domain(self) -> str:
        """The domain directly above servers' names; "" if they have none."""
        return Settings(
            root_domain=self["RootDomain"].strip(".").lower(), servers_host=self["ServersHost"]
        ).servers_domain

    @property
    def certificate(self) -> Location:
        """The place of the servers' certificate in the bucket."""
        return location(self.servers_domain)

    @property
    def env(self) -> dict[str, str]:
        """The functions' environment variables, from which `Account.platform` makes the ports that functions use."""
        return {
            "AWS_REGION": self.region,
            "BUCKET": self["Bucket"],
            "HOSTED_ZONE_ID": self["HostedZoneId"],
            "ROOT_DOMAIN": self["RootDomain"],
            "SERVERS_HOST": self["ServersHost"],
            "MAX_RUNTIME": self["MaxRuntime"],
            "CLUSTER": self["Cluster"],
            "SUBNET": self["Subnets"],
            "SECURITY_GROUP": self["SecurityGroup"],
            "START_SERVER_TOPIC_ARN": self["StartServerTopic"],
            "STOP_SERVER_TOPIC_ARN": self["StopServerTopic"],
            "SCHEDULE_GROUP": self["ScheduleGroup"],
            "SCHEDULE_ROLE_ARN": self["ScheduleRole"],
        }


def describe_stack(account: Account, stack: str) -> Mapping[str, Any] | None:
    """Return the stack of that name or id, as DescribeStacks returns it; None if there is none or it is deleted.

    Raises `Problem` if the stack is no installation of Hippodrome: no command may touch a stack of others.
    """
    try:
        described: Mapping[str, Any] = account.client("cloudformation").describe_stacks(StackName=stack)["Stacks"][0]
    except botocore.exceptions.ClientError as error:
        if is_no_stack(error):
            return None
        raise
    if described["StackStatus"] == "DELETE_COMPLETE":
        return None
    if not is_ours(described):
        raise Problem(
            f"The stack {described['StackName']} in {account.region} is no installation of Hippodrome: "
            "it stays as it is.",
            "Name another with --stack.",
        )
    return described


def is_no_stack(error: botocore.exceptions.ClientError) -> bool:
    """Whether CloudFormation says that there is no stack of that name."""
    return errors.code(error) == "ValidationError" and "does not exist" in errors.message(error)


def is_ours(stack: Mapping[str, Any]) -> bool:
    """Whether a described stack is an installation of Hippodrome, or still empty.

    The tag that `apply` gives it tells, or its parameters if it was made by hand from our template.
    """
    tagged = any(tag["Key"] == TAG for tag in stack.get("Tags", ()))
    return tagged or stack["StackStatus"] == "REVIEW_IN_PROGRESS" or set(parameters_of(stack)) >= _OUR_PARAMETERS


def parameters_of(stack: Mapping[str, Any] | None) -> dict[str, str]:
    """Return the parameters of a described stack."""
    return {
        parameter["ParameterKey"]: parameter.get("ParameterValue", "")
        for parameter in (stack or {}).get("Parameters", ())
    }


def site_host(parameters: Mapping[str, str]) -> str:
    """Return the host name of the site of an installation with these parameters; "" if it has no domain."""
    root = parameters.get("RootDomain", "")
    return f"{parameters.get('SiteHost', '')}.{root}" if root else ""


def servers_domain(parameters: Mapping[str, str]) -> str:
    """Return the domain directly above servers' names for these parameters; "" if servers have no names."""
    settings = Settings(root_domain=parameters["RootDomain"], servers_host=parameters.get("ServersHost", ""))
    return settings.servers_domain


def other_installations(account: Account, stack: str) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the other installations in the account and region: name and parameters of each stack with our tag."""
    for page in account.client("cloudformation").get_paginator("describe_stacks").paginate():
        for other in page["Stacks"]:
            if other["StackName"] != stack and any(tag["Key"] == TAG for tag in other.get("Tags", ())):
                yield other["StackName"], parameters_of(other)


def elsewhere(account: Account, stack: str) -> str:
    """Return a sentence on other regions with a code bucket of that stack's name; "" if there are none or S3 fails.

    S3 lists an account's buckets in all regions.
    """
    try:
        buckets = [str(bucket["Name"]) for bucket in account.fail_fast_client("s3").list_buckets()["Buckets"]]
    except (botocore.exceptions.ClientError, botocore.exceptions.BotoCoreError):
        return ""
    regions_found = {region for bucket in buckets if (region := resource_names.code_bucket_region(stack, bucket))}
    regions = sorted(regions_found - {account.region})
    choices = " or ".join(f"AWS_REGION={region}" for region in regions)
    return f"Something of that name is in another region: say {choices}." if choices else ""


def find_installation(account: Account, stack: str = STACK) -> Installation:
    """Find the installation. Raises `Problem` if there is none, or if its stack's state forbids using it."""
    found = describe_stack(account, stack)
    if found is None or found["StackStatus"] == "REVIEW_IN_PROGRESS":
        raise Problem(
            f"There is no stack named {stack} in {account.region}.",
            elsewhere(account, stack)
            or "Make it with `hippodrome deploy`; or name another region (AWS_REGION, --region) or "
            "installation (--stack).",
        )
    status = found["StackStatus"]
    if status == "DELETE_FAILED":
        raise Problem(f"The stack {stack} is half deleted ({status}).", "Finish it with `hippodrome destroy`.")
    if status in {"ROLLBACK_COMPLETE", "ROLLBACK_FAILED", "CREATE_FAILED"}:
        raise Problem(f"The stack {stack} is in {status}: it does not work.", "Run `hippodrome deploy` to repair it.")
    if status == "CREATE_IN_PROGRESS" or status.startswith(("ROLLBACK_IN", "DELETE_IN")):
        raise Problem(f"The stack {stack} is in {status}.", "Wait until CloudFormation is done, and try again.")
    return Installation.of(account, found)
