"""VPC Block Public Access: a setting of an account's region, or of its organization, that closes internet gateways.

In both modes, `block-bidirectional` and `block-ingress`, nothing passes a gateway in either direction. NAT gateways may
still lead out. Exclusions with the mode `allow-bidirectional` exempt a VPC or a subnet (EC2 API Reference,
VpcBlockPublicAccessOptions and VpcBlockPublicAccessExclusion; read November 2026).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import Account

_IN_FORCE = {"create-complete", "update-complete"}


def blocked(account: Account, vpc: str, subnets: Sequence[str]) -> Problem | None:
    """Say that servers in these subnets of the VPC ("": one that is not made yet) reach nobody; None if they do.

    Raises botocore's errors.
    """
    client = account.client("ec2")
    options = client.describe_vpc_block_public_access_options()["VpcBlockPublicAccessOptions"]
    mode = options["InternetGatewayBlockMode"]
    if mode == "off" or (vpc and _exempt(client, vpc, subnets)):
        return None
    exempt = (
        f"exempt {vpc}" if vpc else "exempt a VPC there and name it (--vpc vpc-… --subnets subnet-…,subnet-…)"
    ) + ": an exclusion that allows both directions"
    if options.get("ManagedBy") == "declarative-policy":
        advice = f"Your organization has set it: ask its administrators to switch it off here, or to {exempt}."
    else:
        advice = (
            f"In the console, VPC, Settings, switch it off, or {exempt}; or switch it off by: aws ec2 "
            f"modify-vpc-block-public-access-options --internet-gateway-block-mode off --region {account.region}"
        )
    return Problem(
        f"VPC Block Public Access ({mode}) closes this account's networks in {account.region}: servers cannot load "
        "their image, and no browser can reach them.",
        advice,
    )


def _exempt(client: Any, vpc: str, subnets: Sequence[str]) -> bool:
    """Return whether the VPC, or each of the subnets, is exempt in both directions."""
    exclusions = client.describe_vpc_block_public_access_exclusions()["VpcBlockPublicAccessExclusions"]  # 50 at most
    exempt = {
        exclusion["ResourceArn"].rpartition("/")[2]
        for exclusion in exclusions
        if exclusion["InternetGatewayExclusionMode"] == "allow-bidirectional" and exclusion["State"] in _IN_FORCE
    }
    return vpc in exempt or exempt.issuperset(subnets)
