"""What is looked at before anything is made, so that mistakes cost seconds and not a rollback."""

from __future__ import annotations

from botocore.exceptions import ClientError

from deploy import screen
from deploy.account import TAG, Account, parameters_of
from deploy.changes import Prepared
from deploy.problem import Problem
from deploy.zone import delegation, read_zone, record_in
from hippodrome.aws import errors


def check(prepared: Prepared) -> None:
    """Look at what is new: the addresses, the network. Raises `Problem`; warns of what may yet turn out well."""
    account, before, after = prepared.account, prepared.before, prepared.parameters
    if (before.get("RootDomain"), before.get("SiteHost")) != (after["RootDomain"], after["SiteHost"]):
        _addresses(prepared)
    if after["VpcId"] and (before.get("VpcId"), before.get("SubnetIds")) != (after["VpcId"], after["SubnetIds"]):
        _network(account, after["VpcId"], after["SubnetIds"].split(","))
    if prepared.standing is None:
        _ecs_role(account)


def _addresses(prepared: Prepared) -> None:
    account, after = prepared.account, prepared.parameters
    _other_stacks(prepared)
    zone = read_zone(account, after["HostedZoneId"])
    site = f"{after['SiteHost']}.{after['RootDomain']}"
    advice = "If that is your installation in another region, check --region; else take another --site, or remove it."
    if record := record_in(account, zone, site):
        raise Problem(f"The zone already has a record of type {record['Type']} for {site}.", advice)
    try:
        account.client("apigatewayv2").get_domain_name(DomainName=site)
    except ClientError as error:
        if errors.code(error) not in {"NotFoundException", "AccessDeniedException", "AccessDenied"}:
            raise
    else:
        raise Problem(f"API Gateway already serves {site} in this region, for something else.", advice)
    found = delegation(zone)
    if found.problem:
        screen.warn(found.problem)
    if found.problem and found.certain:
        screen.warn(
            f"Certificates and servers' names need it: set the name servers of {zone.domain}, where it is registered, "
            f"to {', '.join(zone.name_servers)}."
        )


def _other_stacks(prepared: Prepared) -> None:
    """Two installations may share a domain as long as they never hold the same study: servers would share names."""
    for page in prepared.account.client("cloudformation").get_paginator("describe_stacks").paginate():
        for other in page["Stacks"]:
            ours = any(tag["Key"] == TAG for tag in other.get("Tags", ()))
            same = parameters_of(other).get("RootDomain") == prepared.parameters["RootDomain"]
            if ours and same and other["StackName"] != prepared.stack.name:
                screen.warn(
                    f"The stack {other['StackName']} has the domain {prepared.parameters['RootDomain']} as well: never "
                    "register one project in both. A domain of its own, below that, is safer: "
                    f"--domain {prepared.stack.name.lower()}.{prepared.parameters['RootDomain']}"
                )


def _network(account: Account, vpc: str, subnets: list[str]) -> None:
    try:
        found = account.client("ec2").describe_subnets(SubnetIds=subnets)["Subnets"]
    except ClientError as error:
        if errors.code(error) in {"InvalidSubnetID.NotFound", "InvalidSubnetId.Malformed"}:
            raise Problem(errors.message(error), "Check --subnets and --region.") from None
        raise
    for one in found:
        if one["VpcId"] != vpc:
            raise Problem(f"The subnet {one['SubnetId']} is in {one['VpcId']}, not in {vpc}.")
    if len({one.get("AvailabilityZone") for one in found}) < 2:
        screen.warn("All those subnets are in one zone: when Spot runs out of room there, servers cost more.")


def _ecs_role(account: Account) -> None:
    """ECS's service-linked role: in an account that never used ECS, the first cluster of a template fails without it.

    (aws-cloudformation/cloudformation-coverage-roadmap, issue 818.)
    """
    iam = account.client("iam")
    try:
        iam.create_service_linked_role(AWSServiceName="ecs.amazonaws.com")
    except ClientError as error:
        # InvalidInput: it is there. Whoever may not make it may well find it made.
        if errors.code(error) not in {
            "InvalidInput",
            "AccessDenied",
            "InvalidAction",
            "EntityAlreadyExists",
        }:
            raise
