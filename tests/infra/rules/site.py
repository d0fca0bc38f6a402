"""Rules for the site: its API, its name, its certificate."""

from __future__ import annotations

import itertools
import json
import re
from collections import Counter
from collections.abc import Iterator
from fnmatch import fnmatchcase

from hippodrome.deployment.stack.settings import SITE_LENGTH
from tests.infra.rules.book import Rule, Template, each, first, number, one_of, put, setting, text
from tests.infra.situations import Installation, Resource

API, STAGE, ROUTE, INTEGRATION, DOMAIN, MAPPING = (
    f"AWS::ApiGatewayV2::{kind}" for kind in ("Api", "Stage", "Route", "Integration", "DomainName", "ApiMapping")
)
CERTIFICATE, RECORD = "AWS::CertificateManager::Certificate", "AWS::Route53::RecordSet"
CONFLICT = (
    '"Unable to complete operation due to concurrent modification" (terraform-provider-aws 18018 and 40575, bref 868)'
)
_LABELS = r"([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\.)+[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\.?"


def _format(one: Resource, there: Installation) -> Iterator[str]:
    said = one.properties.get("AccessLogSettings", {}).get("Format", "")
    if "\n" in said or len(said) > 3072:
        yield "its access log's format is not one line of 3 KB"
    if "$context.requestId" not in said:
        yield "its access log does not name requests"


def _crowded(one: Resource, there: Installation) -> Iterator[str]:
    arn = one.properties.get("AccessLogSettings", {}).get("DestinationArn", ":log-group:/aws/vendedlogs/")
    if ":log-group:/aws/vendedlogs/" not in arn:
        yield f"its access log goes to {arn}"


def _routes(there: Installation) -> Iterator[str]:
    keys = Counter((one.properties["ApiId"], one.properties["RouteKey"]) for one in there.of(ROUTE))
    yield from (f"{count} routes {key}" for (_, key), count in keys.items() if count > 1)
    if len(keys) > 300:
        yield f"{len(keys)} routes"


def _at_once(there: Installation) -> Iterator[str]:
    changes = [*there.of(INTEGRATION), *there.of(ROUTE), *there.of(STAGE)]
    before = {one.name: there.waits_for(one.name) for one in changes}
    for one, other in itertools.combinations(changes, 2):
        if one.name not in before[other.name] and other.name not in before[one.name]:
            yield f"{one.name} and {other.name} are made at the same time"


def _versions(one: Resource, there: Installation) -> Iterator[str]:
    if one.properties["IntegrationType"] == "AWS_PROXY" and one.properties.get("PayloadFormatVersion") not in {
        "1.0",
        "2.0",
    }:
        yield "it names no version of the events"


def _slow(one: Resource, there: Installation) -> Iterator[str]:
    """An HTTP API waits for 30 seconds; what a function does later nobody sees."""
    arn = one.properties["IntegrationUri"]
    for function in there.of("AWS::Lambda::Function"):
        if there.account.attribute(function.name, "Arn") == arn and function.properties["Timeout"] >= 30:
            yield f"{function.name} may take {function.properties['Timeout']} s"


def _permitted(there: Installation) -> Iterator[str]:
    allowed = {
        one.properties["FunctionName"]
        for one in there.of("AWS::Lambda::Permission")
        if one.properties["Principal"] == "apigateway.amazonaws.com"
    }
    wanted = {one.properties["IntegrationUri"].rpartition(":")[2] for one in there.of(INTEGRATION)}
    yield from (f"the API may not call {name}" for name in sorted(wanted - allowed))


def _called(there: Installation) -> Iterator[str]:
    """A permission's ARN is compared with that of the call, whose path is the route's; else the site answers 500."""
    account = there.account
    allowed = [
        (one.properties["FunctionName"], one.properties.get("SourceArn", ""))
        for one in there.of("AWS::Lambda::Permission")
        if one.properties["Principal"] == "apigateway.amazonaws.com"
    ]
    for route in there.of(ROUTE):
        integration = there.everything[re.findall(r"\$\{(\w+)\}", route.raw["Properties"]["Target"]["Fn::Sub"])[0]]
        function = integration.properties["IntegrationUri"].rpartition(":")[2]
        method, _, path = route.properties["RouteKey"].partition(" ")
        place = f"arn:aws:execute-api:{account.region}:{account.id}:{route.properties['ApiId']}"
        call = f"{place}/$default/{method}{path}"
        if not any(name == function and fnmatchcase(call, arn) for name, arn in allowed):
            yield f"{route.name} may not call {function}"


def _configured(one: Resource, there: Installation) -> Iterator[str]:
    configurations = one.properties["DomainNameConfigurations"]
    if len(configurations) != 1:
        yield f"{len(configurations)} configurations"
    for found in configurations:
        if found.get("SecurityPolicy") != "TLS_1_2" or found.get("EndpointType") != "REGIONAL":
            yield "an HTTP API takes regional domains with TLS 1.2"


def _dual(there: Installation) -> Iterator[str]:
    """Without IPv6 at the domain an AAAA record leads nowhere."""
    stacks = {
        found.get("IpAddressType") for one in there.of(DOMAIN) for found in one.properties["DomainNameConfigurations"]
    }
    if stacks != {"dualstack"} and any(one.properties["Type"] == "AAAA" for one in there.of(RECORD)):
        yield "an AAAA record of a domain without IPv6"


def _staged(one: Resource, there: Installation) -> Iterator[str]:
    if not {other.name for other in there.of(STAGE)} & there.waits_for(one.name):
        yield "it does not wait for the stage"


def _validated(one: Resource, there: Installation) -> Iterator[str]:
    options = {found["DomainName"]: found for found in one.properties.get("DomainValidationOptions", [])}
    for name in {one.properties["DomainName"], *one.properties.get("SubjectAlternativeNames", [])}:
        if one.properties.get("ValidationMethod") != "DNS" or "HostedZoneId" not in options.get(name, {}):
            yield f"nobody puts the record of {name} into its zone, so the stack waits for hours"


def _aliases(one: Resource, there: Installation) -> Iterator[str]:
    if "AliasTarget" in one.properties and {"TTL", "ResourceRecords"} & set(one.properties):
        yield "an alias with a TTL or values"


def _twice(there: Installation) -> Iterator[str]:
    names = Counter((one.properties["Name"], one.properties["Type"]) for one in there.of(RECORD))
    yield from (f"{count} records {kind} of {name}" for (name, kind), count in names.items() if count > 1)


def _names(there: Installation) -> Iterator[str]:
    for one in there.of(RECORD):
        if len(one.properties["Name"].rstrip(".")) > 253 or not re.fullmatch(_LABELS, one.properties["Name"]):
            yield f"{one.name} is {one.properties['Name']!r}"


def _together(template: Template) -> None:
    template["Resources"]["PostStopRoute"].pop("DependsOn")


def _same_route(template: Template) -> None:
    put(template["Resources"]["HeadNextRoute"]["Properties"], "RouteKey", "GET /next")


def _unwatched(template: Template) -> None:
    for one in template["Resources"].values():
        if one["Type"] == MAPPING:
            one["Properties"]["Stage"] = "$default"


def _plain_log(template: Template) -> None:
    for one in template["Resources"].values():
        if one["Type"] == "AWS::Logs::LogGroup" and "vendedlogs" in json.dumps(one):
            one["Properties"]["LogGroupName"] = {"Fn::Sub": "/hippodrome/${AWS::StackName}/api"}


RULES: tuple[Rule, ...] = (
    *text(API, "Name", "API Gateway API Reference, CreateApi: 128 characters", most=128),
    *text(API, "Description", "API Gateway API Reference, CreateApi: 1,024 characters", most=1024),
    number(
        STAGE,
        "DefaultRouteSettings.ThrottlingBurstLimit",
        "API Gateway Developer Guide, Throttle quota per account per Region: a burst of 5,000, in some Regions of 1,250",
        1,
        1250,
    ),
    number(
        STAGE,
        "DefaultRouteSettings.ThrottlingRateLimit",
        "API Gateway Developer Guide, Throttle quota per account per Region: 10,000 a second where it is listed as supported",
        1,
        10_000,
    ),
    each(
        STAGE,
        "AccessLogSettings.Format",
        "one line of at most 3 KB with $context.requestId",
        "API Gateway Developer Guide, Customize HTTP API access logs; quotas for HTTP APIs: access log template size",
        _format,
        setting(STAGE, "AccessLogSettings.Format", "$context.status"),
    ),
    each(
        STAGE,
        "AccessLogSettings.DestinationArn",
        "a log group of /aws/vendedlogs/: others must be named in a policy of 5,120 characters, one for all APIs",
        'CloudWatch Logs User Guide, Log group resource policy size limit considerations; "Cannot enable logging. Policy '
        'document length breaking Cloudwatch Logs Constraints" (serverless 10469)',
        _crowded,
        _plain_log,
    ),
    *text(
        ROUTE,
        "RouteKey",
        "API Gateway Developer Guide, Routes for HTTP APIs",
        pattern=r"\$default|(ANY|GET|HEAD|POST|OPTIONS|PUT|PATCH|DELETE) /[^\s?#]*",
        spoiled="GET next",
    ),
    Rule(
        ROUTE,
        "RouteKey",
        "each once, 300 at most",
        "API Gateway Developer Guide, Quotas: HTTP APIs",
        _routes,
        _same_route,
    ),
    Rule(ROUTE, "DependsOn", "one change of an API at a time", CONFLICT, _at_once, _together),
    Rule(
        STAGE,
        "DependsOn",
        "one change of an API at a time",
        CONFLICT,
        _at_once,
        lambda t: t["Resources"]["ApiStage"].pop("DependsOn"),
    ),
    Rule(
        INTEGRATION,
        "DependsOn",
        "one change of an API at a time",
        CONFLICT,
        _at_once,
        lambda t: t["Resources"]["SendStopServerMessageIntegration"].update(DependsOn=[]),
    ),
    each(
        INTEGRATION,
        "PayloadFormatVersion",
        "1.0 or 2.0 for a function",
        "API Gateway API Reference, CreateIntegration",
        _versions,
        lambda t: first(t, INTEGRATION).pop("PayloadFormatVersion"),
    ),
    each(
        INTEGRATION,
        "IntegrationUri",
        "a function that answers within 30 seconds",
        "API Gateway Developer Guide, Quotas: maximum integration timeout of HTTP APIs",
        _slow,
        lambda t: put(t["Resources"]["NextStep"]["Properties"], "Timeout", 30),
    ),
    Rule(
        INTEGRATION,
        "IntegrationUri",
        "a function that lets API Gateway call it",
        "API Gateway Developer Guide, Lambda proxy integrations for HTTP APIs",
        _permitted,
        lambda t: t["Resources"].pop("NextStepPermission"),
    ),
    Rule(
        ROUTE,
        "Target",
        "a function whose permission names this route's method and path",
        "API Gateway Developer Guide, Lambda proxy integrations for HTTP APIs: .../api-id/stage/METHOD/path",
        _called,
        lambda t: put(
            t["Resources"]["SignRequestsPermission"]["Properties"],
            "SourceArn",
            {"Fn::Sub": "arn:${AWS::Partition}:execute-api:${AWS::Region}:${AWS::AccountId}:${Api}/*/*/signed"},
        ),
    ),
    each(
        DOMAIN,
        "DomainNameConfigurations",
        "one, regional, TLS 1.2",
        "API Gateway API Reference, DomainNameConfiguration: HTTP APIs",
        _configured,
        setting(DOMAIN, "DomainNameConfigurations.*.SecurityPolicy", "TLS_1_0"),
    ),
    Rule(
        DOMAIN,
        "IpAddressType",
        "dualstack, if there is an AAAA record",
        "API Gateway Developer Guide, IP address types for HTTP APIs; aws-cdk 34403: the AAAA record leads nowhere otherwise",
        _dual,
        setting(DOMAIN, "DomainNameConfigurations.*.IpAddressType", "ipv4"),
    ),
    each(
        MAPPING,
        "Stage",
        "one that is made before",
        "API Gateway API Reference, CreateApiMapping: NotFoundException",
        _staged,
        _unwatched,
    ),
    *text(
        CERTIFICATE,
        "DomainName",
        "ACM API Reference, RequestCertificate: the first name has 64 octets at most",
        most=64,
        pattern=r"(\*\.)?" + _LABELS,
        spoiled="Study.example.org",
    ),
    each(
        CERTIFICATE,
        "DomainValidationOptions",
        "DNS, with the zone of each name",
        "CloudFormation User Guide, AWS::CertificateManager::Certificate: CREATE_IN_PROGRESS until validated",
        _validated,
        lambda t: first(t, CERTIFICATE)["DomainValidationOptions"][0].pop("HostedZoneId"),
    ),
    one_of(RECORD, "Type", "Route 53 API Reference, ResourceRecordSet", ("A", "AAAA", "CNAME", "TXT", "CAA")),
    each(
        RECORD,
        "AliasTarget",
        "without TTL and values",
        "Route 53 API Reference, ResourceRecordSet: TTL",
        _aliases,
        setting(RECORD, "TTL", "60"),
    ),
    Rule(
        RECORD,
        "Name",
        "one of a type and name",
        "Route 53 API Reference, ChangeResourceRecordSets",
        _twice,
        lambda t: put(t["Resources"]["SiteRecordV6"]["Properties"], "Type", "A"),
    ),
    Rule(
        RECORD,
        "Name",
        "labels of 63 characters, 253 in all",
        "Route 53 Developer Guide, DNS domain name format",
        _names,
        setting(RECORD, "Name", f"{'x' * 64}.example.org."),
    ),
)

assert SITE_LENGTH == 64, "what deploy refuses is what the rule for certificates says"
