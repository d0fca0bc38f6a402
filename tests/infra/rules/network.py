"""Rules for the network: security groups, subnets, routes."""

from __future__ import annotations

import ipaddress
import json
from collections.abc import Iterator

from tests.infra.rules.book import Rule, Spoil, Template, each, first, number, setting, text
from tests.infra.situations import Installation, Resource

GROUP, SUBNET, VPC, ROUTE, ENDPOINT = (
    f"AWS::EC2::{kind}" for kind in ("SecurityGroup", "Subnet", "VPC", "Route", "VPCEndpoint")
)
ASSOCIATION, ATTACHMENT = "AWS::EC2::SubnetRouteTableAssociation", "AWS::EC2::VPCGatewayAttachment"
DESCRIPTIONS = (
    'EC2 API Reference, SecurityGroupRuleDescription; the error "Valid descriptions are strings less than 256 characters '
    'from the following set: a-zA-Z0-9. _-:/()#,@[]+=&;{}!$*" (terraform-provider-aws 9528 and 18874, cfn-lint 173)'
)
TASKS = "ECS Developer Guide, Fargate task networking, and Stopped task error messages"
_SET = r"[a-zA-Z0-9. _\-:/()#,@\[\]+=&;{}!$*]*"


def _same_rules(one: Resource, there: Installation) -> Iterator[str]:
    for side in ("SecurityGroupIngress", "SecurityGroupEgress"):
        rules = [
            json.dumps({key: rule[key] for key in sorted(rule) if key != "Description"})
            for rule in one.properties.get(side, [])
        ]
        if len(rules) != len(set(rules)):
            yield f"{side} has one rule twice"


def _outside(there: Installation) -> Iterator[str]:
    for vpc in there.of(VPC):
        room = ipaddress.ip_network(vpc.properties["CidrBlock"])
        taken: list[ipaddress.IPv4Network | ipaddress.IPv6Network] = []
        for subnet in there.of(SUBNET):
            range_ = ipaddress.ip_network(subnet.properties["CidrBlock"])
            if not (range_.version == room.version and range_.subnet_of(room)):  # type: ignore[arg-type]
                yield f"{subnet.name} is not within {vpc.name}"
            if any(range_.overlaps(other) for other in taken):
                yield f"{subnet.name} overlaps another subnet"
            taken.append(range_)


def _size(one: Resource, there: Installation) -> Iterator[str]:
    if not 16 <= ipaddress.ip_network(one.properties["CidrBlock"]).prefixlen <= 28:
        yield f"its range is {one.properties['CidrBlock']}"


def _moving(one: Resource, there: Installation) -> Iterator[str]:
    if "GetAZs" in json.dumps(one.raw["Properties"]["AvailabilityZone"]):
        yield "its zone is what Fn::GetAZs lists at the moment"


def _early(one: Resource, there: Installation) -> Iterator[str]:
    attached = {other.name for other in there.of("AWS::EC2::VPCGatewayAttachment")}
    if "GatewayId" in one.properties and not attached & there.waits_for(one.name):
        yield "it does not wait for the gateway's attachment"


def _not_a_gateway(one: Resource, there: Installation) -> Iterator[str]:
    if one.properties.get("VpcEndpointType") == "Gateway":
        for key in {"SubnetIds", "SecurityGroupIds", "PrivateDnsEnabled"} & set(one.properties):
            yield f"{key} is for interface endpoints"
        if not one.properties.get("RouteTableIds"):
            yield "it has no route table"


def _shut_in(one: Resource, there: Installation) -> Iterator[str]:
    """What Fargate and the trial need of the Internet: the image, the log, the bucket, the site; all of it by TLS."""
    open_ports = [
        (rule["FromPort"], rule["ToPort"])
        for rule in one.properties.get("SecurityGroupEgress", [])
        if rule["IpProtocol"] == "tcp" and rule.get("CidrIp") == "0.0.0.0/0"
    ]
    if not any(first <= 443 <= last for first, last in open_ports):
        yield "servers reach nobody at port 443"


def _unresolved(one: Resource, there: Installation) -> Iterator[str]:
    if one.properties.get("EnableDnsSupport") is not True:
        yield "nobody in it resolves names"


def _lost(one: Resource, there: Installation) -> Iterator[str]:
    """A public address is of use only where the subnet's table leads to the Internet gateway."""
    ways = {
        json.dumps(way.raw["Properties"]["RouteTableId"])
        for way in there.of(ROUTE)
        if way.properties["DestinationCidrBlock"] == "0.0.0.0/0" and "GatewayId" in way.properties
    }
    tables = {
        json.dumps(other.raw["Properties"]["RouteTableId"])
        for other in there.of(ASSOCIATION)
        if other.raw["Properties"]["SubnetId"] == {"Ref": one.name}
    }
    if not tables & ways:
        yield "no way leads from it to the Internet"


def _tables_of_a_subnet(there: Installation) -> Iterator[str]:
    subnets = [one.raw["Properties"]["SubnetId"]["Ref"] for one in there.of(ASSOCIATION)]
    yield from (
        f"{name} has {subnets.count(name)} route tables" for name in sorted(set(subnets)) if subnets.count(name) > 1
    )


def _gateways_of_a_vpc(there: Installation) -> Iterator[str]:
    vpcs = [one.raw["Properties"]["VpcId"]["Ref"] for one in there.of(ATTACHMENT)]
    yield from (f"{name} has {vpcs.count(name)} gateways" for name in sorted(set(vpcs)) if vpcs.count(name) > 1)


def _same_destinations(there: Installation) -> Iterator[str]:
    ways = [
        (one.raw["Properties"]["RouteTableId"]["Ref"], one.properties["DestinationCidrBlock"])
        for one in there.of(ROUTE)
    ]
    yield from (
        f"{table} has {ways.count((table, way))} routes to {way}"
        for table, way in sorted(set(ways))
        if ways.count((table, way)) > 1
    )


def _again(name: str) -> Spoil:
    return lambda template: template["Resources"].update(Again=template["Resources"][name])


def _fixed(name: str, kind: str, path: str, value: str, why: str) -> Rule:
    def faults(there: Installation) -> Iterator[str]:
        found = there.everything.get(name)
        if found is not None and found.properties[path] != value:
            yield f"{name}.{path} was {value!r}: {why}"

    def spoil(template: Template) -> None:
        template["Resources"][name]["Properties"][path] = "10.86.192.0/20" if "Cidr" in path else "Servers"

    return Rule(kind, path, f"of {name}: stays {value!r}", f"{kind}: createOnlyProperties; {why}", faults, spoil)


def _undepend(template: Template) -> None:
    route = next(one for one in template["Resources"].values() if one["Type"] == ROUTE)
    route.pop("DependsOn")


def _overlap(template: Template) -> None:
    subnets = [one for one in template["Resources"].values() if one["Type"] == SUBNET]
    subnets[1]["Properties"]["CidrBlock"] = subnets[0]["Properties"]["CidrBlock"]


def _twice(template: Template) -> None:
    rules = first(template, GROUP)["SecurityGroupIngress"]
    rules.append(dict(rules[0], Description="once more"))


_REPLACED = "a subnet or VPC that is replaced is made beside the old one, with servers in it"

RULES = (
    *(
        rule
        for path in ("GroupDescription", "SecurityGroupIngress.*.Description", "SecurityGroupEgress.*.Description")
        for rule in text(
            GROUP,
            path,
            DESCRIPTIONS,
            most=255,
            pattern=_SET,
            spoiled="participants' browsers",
            accepts="the characters a-zA-Z0-9. _-:/()#,@[]+=&;{}!$*",
        )
    ),
    number(GROUP, "SecurityGroupIngress.*.ToPort", "EC2 API Reference, IpPermission", -1, 65535),
    each(
        GROUP,
        "SecurityGroupIngress",
        "no rule twice",
        "EC2 API Reference, error code InvalidPermission.Duplicate",
        _same_rules,
        _twice,
    ),
    _fixed(
        "SecurityGroup", GROUP, "GroupDescription", "Servers of the participants", "servers' interfaces use the group"
    ),
    _fixed("Vpc", VPC, "CidrBlock", "10.86.0.0/16", _REPLACED),
    _fixed("SubnetA", SUBNET, "CidrBlock", "10.86.64.0/18", _REPLACED),
    _fixed("SubnetB", SUBNET, "CidrBlock", "10.86.128.0/18", _REPLACED),
    Rule(SUBNET, "CidrBlock", "within the VPC's, and apart", "EC2 API Reference, CreateSubnet", _outside, _overlap),
    each(
        GROUP,
        "SecurityGroupEgress",
        "port 443 to everywhere, for who has no interface endpoints",
        f"{TASKS}: CannotPullContainerError, ResourceInitializationError without a way to ECR and CloudWatch Logs",
        _shut_in,
        setting(GROUP, "SecurityGroupEgress.*.FromPort", 444),
    ),
    each(
        VPC,
        "EnableDnsSupport",
        "true, for tasks that resolve names by Amazon's server",
        TASKS,
        _unresolved,
        setting(VPC, "EnableDnsSupport", False),
    ),
    each(
        SUBNET,
        "VpcId",
        "a subnet whose table leads to the Internet gateway, for tasks with a public address",
        TASKS,
        _lost,
        setting(ROUTE, "DestinationCidrBlock", "10.0.0.0/8"),
    ),
    each(
        VPC,
        "CidrBlock",
        "between /16 and /28",
        "VPC User Guide, VPC CIDR blocks",
        _size,
        setting(VPC, "CidrBlock", "10.0.0.0/8"),
    ),
    each(
        SUBNET,
        "CidrBlock",
        "between /16 and /28",
        "VPC User Guide, Subnet sizing",
        _size,
        setting(SUBNET, "CidrBlock", "10.86.64.0/29"),
    ),
    each(
        SUBNET,
        "AvailabilityZone",
        "chosen once: a subnet that moves is made anew with the range of the old one",
        "EC2 API Reference, error code InvalidSubnet.Conflict; CloudFormation User Guide, Fn::GetAZs: what it lists depends "
        "on the account and its default subnets",
        _moving,
        setting(SUBNET, "AvailabilityZone", {"Fn::Select": [0, {"Fn::GetAZs": ""}]}),
    ),
    each(
        ROUTE,
        "GatewayId",
        "only after the gateway's attachment",
        "CloudFormation User Guide, DependsOn attribute: when a DependsOn attribute is required",
        _early,
        _undepend,
    ),
    Rule(
        ROUTE,
        "DestinationCidrBlock",
        "one route to a destination in a table",
        "EC2 API Reference, error code RouteAlreadyExists",
        _same_destinations,
        _again("InternetRoute"),
    ),
    Rule(
        ASSOCIATION,
        "SubnetId",
        "one route table for a subnet",
        "EC2 API Reference, error code Resource.AlreadyAssociated",
        _tables_of_a_subnet,
        _again("SubnetARoutes"),
    ),
    Rule(
        ATTACHMENT,
        "VpcId",
        "one Internet gateway for a VPC",
        "EC2 API Reference, AttachInternetGateway; error code Resource.AlreadyAssociated",
        _gateways_of_a_vpc,
        _again("InternetGatewayAttachment"),
    ),
    each(
        ENDPOINT,
        "VpcEndpointType",
        "a gateway endpoint has route tables, and no subnets, security groups or private names",
        "EC2 API Reference, CreateVpcEndpoint",
        _not_a_gateway,
        setting(ENDPOINT, "SubnetIds", [{"Ref": "SubnetA"}]),
    ),
)
