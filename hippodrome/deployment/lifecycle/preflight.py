"""Checks before anything is made. One list of findings shows all mistakes in seconds, without a rollback.

A finding is bad if the stack would fail, or wait for hours; bad findings stop the command. A finding that does not
prevent a first study is only worth a look. So is a check that these credentials may not make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import UTC, datetime
from typing import TYPE_CHECKING, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws import concurrency, public_access, quotas, regions
from hippodrome.deployment.aws.account import Account, other_installations, servers_domain, site_host
from hippodrome.deployment.aws.hosted_zone import read_zone, record_in
from hippodrome.deployment.core.finding import Finding, Mark, bad, examine, look, show
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.stack import domain, domain_change, inventory
from hippodrome.deployment.stack.changes import Prepared

if TYPE_CHECKING:
    from hippodrome.deployment.core.project_folder import ProjectFolder

FEW = 20  # if the quota allows fewer servers at once, the advice is to ask AWS for more
USUAL = 1.0  # vCPU of a server, if no study says how many


class AccountCheck(NamedTuple):
    """An account without an installation, and the study that will be registered there, if any."""

    account: Account
    study: ProjectFolder | None


def of_problem(name: str, problem: Problem) -> Finding:
    """Make a bad finding of a problem."""
    return bad(name, "\n    ".join([str(problem), *problem.details]), problem.advice)


def stop(findings: Iterable[Finding], *, anyway: bool = False) -> None:
    """Show all findings, bad ones last. Raises `Problem` if one of them is bad, unless `anyway`."""
    findings = _bad_last(findings)
    show(findings, screen.err)
    bads = sum(finding.mark is Mark.BAD for finding in findings)
    if bads and not anyway:
        raise Problem(
            f"{count(bads, 'thing')} {'is' if bads == 1 else 'are'} in the way, marked ✗. Nothing was deployed.",
            "Put that right, and run the same command again.",
        )


def look_at_account(account: Account, study: ProjectFolder | None) -> list[Finding]:
    """Check the account before a first installation, for the `study` that will be registered."""
    return examine(AccountCheck(account, study), _OF_ACCOUNT)


def look_at(prepared: Prepared, study: ProjectFolder | None = None) -> list[Finding]:
    """Check everything that is new or changes, and return the findings that are not good, bad ones last."""
    before, after = prepared.before, prepared.parameters
    new_network = (before.get("VpcId") or "") != after["VpcId"]
    new_site = (before.get("RootDomain"), before.get("SiteHost")) != (after["RootDomain"], after["SiteHost"])
    checks: dict[str, Callable[[Prepared], Iterable[Finding]]] = {}
    if after["RootDomain"] and (new_site or domain_change.moves(prepared)):
        checks |= {"domain": _domain, "other stacks": _other_stacks}
    if after["RootDomain"] and new_site:
        checks["site"] = _site
    if prepared.existing is not None:
        checks["servers"] = _servers_that_run
    if after["VpcId"] and (new_network or before.get("SubnetIds") != after["SubnetIds"]):
        checks["network"] = _subnets
    if prepared.existing is None or new_network:
        checks["Internet"] = _internet
    if prepared.existing is None:
        checks |= {"VPCs": _vpcs, "left over": _left_over}
    findings = look_at_account(prepared.account, study) if prepared.existing is None else []
    findings += examine(prepared, checks)
    return _bad_last(finding for finding in findings if finding.mark is not Mark.GOOD)


def _bad_last(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings with the bad ones at the end, so that long remarks do not scroll them off the screen."""
    return sorted(findings, key=lambda finding: finding.mark is Mark.BAD)


# -- the account ------------------------------------------------------------------------------------------------------


def _region(checked: AccountCheck) -> Iterator[Finding]:
    try:
        regions.check(checked.account.region)
    except Problem as problem:
        yield of_problem("region", problem)


def _executions(checked: AccountCheck) -> Iterator[Finding]:
    """Check Lambda's concurrent executions, which pages and the functions behind queues share (`aws.concurrency`)."""
    account = checked.account
    free = concurrency.unreserved(account)
    if concurrency.starts(free) < concurrency.USUAL:
        pages, starts = max(0, free - concurrency.workers(free)), concurrency.starts(free)
        yield look(
            "Lambda",
            f"This account runs {free} functions at once: {pages} for participants' pages, {starts} to start servers. "
            "That is enough to try it out; of links that are opened in the same second, some show an error.",
            f"Ask for more, and then deploy again: {quotas.request(account, quotas.EXECUTIONS, 1000)}",
        )


def _servers(checked: AccountCheck) -> Iterator[Finding]:
    account, study = checked
    if study and not study.plays:
        return
    cpu = float(study.registration["awsSetup"]["cpu"]) if study else USUAL
    if quotas.applied(account, quotas.SPOT) == quotas.applied(account, quotas.ON_DEMAND) == 0:
        yield bad(
            "Fargate",
            "This account may run no server at all: both of Fargate's quotas are 0 vCPU.",
            quotas.ask_for(account, quotas.ON_DEMAND, FEW * cpu),
        )
        return
    for kind, quota in (("Spot", quotas.SPOT), ("on demand", quotas.ON_DEMAND)):
        value = quotas.applied(account, quota)
        if value is None or value >= FEW * cpu:
            continue
        servers = int(value // cpu)
        yield look(
            f"Fargate, {kind}",
            f"{value:g} vCPU: {count(servers, 'server')} of {cpu:g} vCPU may run at once"
            + ("." if kind == "Spot" else ", if Spot has no room."),
            quotas.ask_for(account, quota, FEW * cpu),
        )


_OF_ACCOUNT: Mapping[str, Callable[[AccountCheck], Iterable[Finding]]] = {
    "region": _region,
    "Lambda": _executions,
    "Fargate": _servers,
}


# -- the addresses ----------------------------------------------------------------------------------------------------


def _domain(prepared: Prepared) -> Iterator[Finding]:
    after = prepared.parameters
    zone = read_zone(prepared.account, after["HostedZoneId"])
    return domain.look_at(prepared.account, zone, servers_domain(after), site_host(after))


def _site(prepared: Prepared) -> Iterator[Finding]:
    account, after = prepared.account, prepared.parameters
    site = site_host(after)
    advice = (
        "If that is your installation in another region, set AWS_REGION to that one; else take another --site, or "
        "remove it."
    )
    if record := record_in(account, read_zone(account, after["HostedZoneId"]), site):
        yield bad("site", f"The zone already has a record of type {record['Type']} for {site}.", advice)
    try:
        account.client("apigatewayv2").get_domain_name(DomainName=site)
    except ClientError as error:
        if errors.code(error) != "NotFoundException":
            raise
    else:
        yield bad("site", f"API Gateway already serves {site} in this region, for something else.", advice)


def _other_stacks(prepared: Prepared) -> Iterator[Finding]:
    """Check the other installations, whose names must not meet this one's.

    With the same domain and the same study, the servers of both would have the same names. And every agent can read the
    key of the servers' certificate, which must not be valid for the site of another installation.
    """
    name, root = prepared.stack.name, prepared.parameters["RootDomain"]
    for other, parameters in other_installations(prepared.account, name):
        if parameters.get("RootDomain") == root:
            yield look(
                "domain",
                f"The stack {other} has the domain {root} as well: never register a project in both.",
                f"A domain of its own, below that, is safer: --domain {name.lower()}.{root}",
            )
        domains = servers_domain(prepared.parameters), parameters.get("RootDomain")
        if "ServersHost" in parameters and (domains[0] == domains[1] or servers_domain(parameters) == root):
            yield bad(
                "servers' names",
                f"The servers' certificate of one installation would be for the site of the other: this one and "
                f"{other}.",
                "Take another --domain or another --servers.",
            )


def _servers_that_run(prepared: Prepared) -> Iterator[Finding]:
    """Check that no server runs while its name, the site's, or the network is replaced.

    No page could reach a server of the old domain, and its name would stay. CloudFormation deletes the site's old
    address, at which participants have pages open, and the old network's route to the Internet. The API's own address
    stays, so servers without names, and their pages, may run while a domain is added.
    """
    before, after = domain_change.present(prepared), prepared.parameters
    if before is None:
        return
    changing = ["their network"] if (prepared.before.get("VpcId") or "") != after["VpcId"] else []
    if before.has_domain and before.servers_domain != servers_domain(after):
        changing.append(f"their names below {before.servers_domain}")
    if before.has_domain and site_host(prepared.before) != site_host(after):
        changing.append(f"the address of participants' pages, {site_host(prepared.before)}")
    if not changing:
        return
    platform = prepared.account.platform(before)
    if running := Records(platform.documents).open(platform.settings.max_runtime, datetime.now(UTC)):
        yield bad(
            "servers",
            f"This would take away, while {count(len(running), 'server')} "
            f"{'runs' if len(running) == 1 else 'run'}: {', '.join(changing)}.",
            "Wait until they have ended, or end them with `hippodrome stop --all`; then deploy again. Warm servers end "
            "for good when their study is closed (`hippodrome register --no-live`).",
        )


# -- the network, and what an earlier installation has left -----------------------------------------------------------


def _subnets(prepared: Prepared) -> Iterator[Finding]:
    after = prepared.parameters
    vpc, subnets = after["VpcId"], after["SubnetIds"].split(",")
    try:
        described = prepared.account.client("ec2").describe_subnets(SubnetIds=subnets)["Subnets"]
    except ClientError as error:
        if errors.code(error) not in {"InvalidSubnetID.NotFound", "InvalidSubnetId.Malformed"}:
            raise
        yield bad("network", errors.message(error), "Check --subnets and --region.")
        return
    for subnet in described:
        if subnet["VpcId"] != vpc:
            yield bad(
                "network",
                f"The subnet {subnet['SubnetId']} is in {subnet['VpcId']}, not in {vpc}.",
                "Name a VPC and its own subnets: --vpc and --subnets.",
            )
    if len({subnet.get("AvailabilityZone") for subnet in described}) < 2:
        yield look(
            "network",
            "All those subnets are in one zone: when Spot runs out of room there, servers cost more.",
            "Name subnets in two zones: --subnets.",
        )
    yield from _endpoint(prepared, vpc)


def _endpoint(prepared: Prepared, vpc: str) -> Iterator[Finding]:
    """Check for an endpoint that answers for the addresses of all APIs, but reaches private ones alone.

    Its servers would get status 403 for each request (AWS re:Post, "api-gateway-vpc-connections", read November 2026).
    """
    filters = [{"Name": "vpc-id", "Values": [vpc]}]
    pages = prepared.account.client("ec2").get_paginator("describe_vpc_endpoints").paginate(Filters=filters)
    for private in (endpoint for page in pages for endpoint in page["VpcEndpoints"]):
        if private["ServiceName"].endswith(".execute-api") and private.get("PrivateDnsEnabled"):
            yield bad(
                "network",
                f"The endpoint {private['VpcEndpointId']} of {vpc} has private DNS, so servers could not reach the "
                "functions, to store data and to get certificates.",
                "Switch its private DNS off, or name another VPC: --vpc and --subnets.",
            )


def _internet(prepared: Prepared) -> Iterator[Finding]:
    """Check that the account's settings let servers reach the Internet, and browsers reach them."""
    after = prepared.parameters
    subnets = after["SubnetIds"].split(",") if after["VpcId"] else []
    if problem := public_access.blocked(prepared.account, after["VpcId"], subnets):
        yield of_problem("Internet", problem)


def _vpcs(prepared: Prepared) -> Iterator[Finding]:
    """Check the quota of VPCs, which is 5 in a Region at first, for an installation with a VPC of its own."""
    if prepared.parameters["VpcId"]:
        return
    pages = prepared.account.client("ec2").get_paginator("describe_vpcs").paginate()
    present = sum(len(page["Vpcs"]) for page in pages)
    allowed = quotas.applied(prepared.account, quotas.VPCS)
    if allowed is not None and present >= allowed:
        yield bad(
            "VPCs",
            f"There are {present} VPCs in {prepared.account.region}, and this account may have no more.",
            "Use one of them (--vpc vpc-… --subnets subnet-…,subnet-…), or ask for one more: "
            + quotas.request(prepared.account, quotas.VPCS, present + 1),
        )


def _left_over(prepared: Prepared) -> Iterator[Finding]:
    """Check for log groups that an unfinished `destroy` has left: the stack cannot make groups of the same names."""
    name = prepared.stack.name
    if prepared.described is None and (log_groups := inventory.log_groups(prepared.account, name)):
        yield bad(
            "left over",
            f"An earlier installation {name} has left {count(len(log_groups), 'log group')}, such as {log_groups[0]}.",
            f"Finish its removal: `hippodrome destroy --stack {name}`. The data stay.",
        )
