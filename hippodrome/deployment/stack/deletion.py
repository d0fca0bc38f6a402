"""Deletes a stack. If something blocks the deletion for a while, waits for it or removes it, and tries again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from hippodrome.console import screen
from hippodrome.console.formatting import duration
from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.stack import acm_records, guardduty, policies
from hippodrome.deployment.stack.deletion_failures import Recovery, recoveries, recovery_from
from hippodrome.deployment.stack.stack import FailedResource, NotDeleted, Stack

TRIES = 8  # attempts to delete the stack
PAUSE = 20  # seconds between two looks at what blocks the deletion
IN_USE = 75 * 60
"""The seconds for which a certificate may stay in use after API Gateway's domain is gone: 10 to 60 minutes are reported
(aws/aws-cdk issues 36265 and 16608; amplify-education/serverless-domain-manager issue 32)."""
DISAGREEING = 5 * 60  # seconds to wait if CloudFormation says that the certificate is in use, and ACM lists no use
NETWORK_IN_USE = 25 * 60
"""The seconds for which network interfaces of tasks that have ended may stay: 5 to 20 minutes are reported
(alchemy-run/alchemy pull request 1125)."""


class StackDeletion:
    """Deletes a stack. `stop_servers` is called before each try."""

    def __init__(
        self, account: Account, stack: Stack, executor: Executor, stop_servers: Callable[[], None] = lambda: None
    ) -> None:
        self._account = account
        self._stack = stack
        self._executor = executor
        self._stop_servers = stop_servers
        self._without: list[str] = []  # logical ids of resources that the next try leaves out

    def run(self, title: str = "Deleting the stack") -> None:
        """Delete the stack, in up to `TRIES` tries. Raises `Problem` for a failure that waiting does not end."""
        self._executor.retry(lambda: self._try(title), self._recover, TRIES)

    def _try(self, title: str) -> None:
        self._stop_servers()
        self._free_policies()
        self._stack.delete(title, self._without)

    def _recover(self, error: Exception) -> bool:
        """Wait for what blocks the deletion, or remove it. Return False if neither is possible."""
        if not isinstance(error, NotDeleted) or not (needed := recoveries(error.failures)):
            return False
        self._without = [failure.logical_id for failure in error.failures if recovery_from(failure) is Recovery.GONE]
        for recovery in needed:
            screen.info(f"This has to wait until {recovery.value}; then the rest is deleted.")
            self._help(recovery, error.failures)
        return True

    def _help(self, recovery: Recovery, failures: Sequence[FailedResource]) -> None:
        match recovery:
            case Recovery.CERTIFICATE:
                for failure in failures:
                    if failure.type == "AWS::CertificateManager::Certificate":
                        self._certificate_free(failure.physical_id)
            case Recovery.NETWORK:
                self._network_free()
            case Recovery.ROLE:
                for failure in failures:
                    if failure.type == "AWS::IAM::Role":
                        policies.free_role(self._account, failure.physical_id)
            case Recovery.PAUSE:
                self._executor.sleep(PAUSE)
            case Recovery.SERVERS | Recovery.POLICY | Recovery.GONE:
                pass  # each try does that itself

    def _free_policies(self) -> None:
        """Detach the stack's managed policies, and print to whom they were attached."""
        for arn in self._stack.ids_of("AWS::IAM::ManagedPolicy"):
            if freed := policies.detach(self._account, arn):
                screen.success(f"The policy {freed.name} is detached from {freed.whom}.")

    def _certificate_free(self, arn: str) -> None:
        """Wait until ACM lists nothing that uses the certificate. Raises `Problem` after `IN_USE` seconds."""

        def users() -> list[str]:
            arns = acm_records.in_use_by(self._account, arn)
            if others := [arn_of_user for arn_of_user in arns if _is_other_use(self._account, arn_of_user)]:
                raise Problem(
                    f"The site's certificate is used by {', '.join(others)}.",
                    "Take the certificate away from there, and run the same command again.",
                )
            return arns

        title = "The site's certificate is in use until AWS has dismantled the site's address: 10 to 60 minutes"
        # ACM's list of uses and its refusals to delete need not agree at once.
        if users_now := self._until_none(users, title, IN_USE, disagreeing=DISAGREEING):
            raise Problem(
                f"After {duration(IN_USE)} ACM still says that the site's certificate is in use by "
                f"{', '.join(users_now)}.",
                "Run the same command later; it goes on from here. If that lasts for a day, only AWS's support can "
                "release it. It costs nothing.",
            )

    def _network_free(self) -> None:
        """Wait until the stack's network has no network interface. Raises `Problem` after `NETWORK_IN_USE` seconds.

        What GuardDuty has put into the stack's own VPC is removed.
        """
        vpcs, groups = self._stack.ids_of("AWS::EC2::VPC"), self._stack.ids_of("AWS::EC2::SecurityGroup")
        where = {"Name": "vpc-id", "Values": vpcs} if vpcs else {"Name": "group-id", "Values": groups}
        client = self._account.client("ec2")
        guardduty.remove_endpoints(client, vpcs)

        def interfaces() -> list[str]:
            pages = client.get_paginator("describe_network_interfaces").paginate(Filters=[where])
            all_interfaces = (
                [interface for page in pages for interface in page["NetworkInterfaces"]] if where["Values"] else []
            )
            for one in all_interfaces:
                if instance := one.get("Attachment", {}).get("InstanceId"):
                    raise Problem(
                        f"The instance {instance} is in the network of the installation.",
                        "It is not Hippodrome's: remove it, and run the same command again.",
                    )
            return [str(interface["NetworkInterfaceId"]) for interface in all_interfaces]

        title = "The addresses of servers that have ended are in use for up to 20 minutes"
        if interfaces_left := self._until_none(interfaces, title, NETWORK_IN_USE, disagreeing=PAUSE):
            raise Problem(
                f"After {duration(NETWORK_IN_USE)} the network still has the interfaces {', '.join(interfaces_left)}.",
                "See in the EC2 console what they belong to, remove that, and run the same command again.",
            )
        guardduty.remove_groups(client, vpcs)

    def _until_none(
        self, look: Callable[[], Sequence[str]], title: str, seconds: float, disagreeing: float
    ) -> Sequence[str]:
        """Wait until a look finds nothing, for `seconds` at most. Return what the last look found.

        AWS has refused a deletion because something is in use. If the first look finds nothing, AWS's lists are not up
        to date, so no look can tell: wait `disagreeing` seconds.
        """
        if not look():
            self._executor.sleep(disagreeing)
            return ()
        return self._executor.wait(look, seconds, pause=PAUSE, title=f"{title}; it is safe to interrupt this")


def _is_other_use(account: Account, arn: str) -> bool:
    """Whether a resource outside of API Gateway uses the certificate. API Gateway's own uses end by themselves."""
    _, _, service, _, owner, *_ = arn.split(":")
    return owner == account.id and service != "apigateway"
