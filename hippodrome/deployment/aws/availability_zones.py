"""The two availability zones of an installation's own VPC: chosen once, and kept by every later apply.

A subnet cannot move to another zone: CloudFormation would make the new subnet before it removes the old one, and both
would have the same range. So the zones are parameters of the template; `Fn::GetAZs` may list others at each update.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from botocore.exceptions import ClientError

from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.regions import runs_fargate

PARAMETERS = ("ZoneA", "ZoneB")


def choose(account: Account, previous: Mapping[str, str], subnets: Sequence[str] = ()) -> dict[str, str]:
    """Choose the template's parameters for zones: the stack's, else its subnets' zones, else two that run Fargate.

    `previous` are the stack's parameters, `subnets` the ids of the subnets in its own VPC, if it has one. Raises
    `Problem` if the region has no two such zones.
    """
    if all(previous.get(name) for name in PARAMETERS):
        return {name: previous[name] for name in PARAMETERS}
    zones = _zones_of(account, subnets) or _fargate_zones(account)
    if len(zones) < 2:
        raise Problem(
            f"{account.region} has no two availability zones that run Fargate in this account.",
            "Choose another region with --region, or a network of yours: --vpc vpc-… --subnets subnet-…,subnet-…",
        )
    return dict(zip(PARAMETERS, zones, strict=False))


def _zones_of(account: Account, subnets: Sequence[str]) -> list[str]:
    """Return the zones of these subnets, in the subnets' order; empty if one of the subnets is gone."""
    if not subnets:
        return []
    try:
        found = account.client("ec2").describe_subnets(SubnetIds=list(subnets))["Subnets"]
    except ClientError as error:
        if errors.code(error) in {"InvalidSubnetID.NotFound", "InvalidSubnetId.Malformed"}:
            return []
        raise
    zones = {subnet["SubnetId"]: str(subnet["AvailabilityZone"]) for subnet in found}
    return [zones[name] for name in subnets if name in zones]


def _fargate_zones(account: Account) -> list[str]:
    """Return the region's zones that run Fargate and that this account can use, sorted, without local zones."""
    availability_zones = account.client("ec2").describe_availability_zones()["AvailabilityZones"]
    return sorted(
        str(zone["ZoneName"])
        for zone in availability_zones
        if zone.get("State") == "available"
        and zone.get("ZoneType", "availability-zone") == "availability-zone"
        and zone.get("OptInStatus") != "not-opted-in"
        and runs_fargate(account.region, str(zone["ZoneId"]))
    )
