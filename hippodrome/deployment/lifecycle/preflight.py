"""Checks before anything is made. One list of findings shows all mistakes in seconds, without a rollback.

A finding is bad if the stack would fail, or wait for hours; bad findings stop the command. A finding that does not
prevent a first study is only worth a look. So is a check that these credentials may not make.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.control.certificates.rules import names_of, proof_name
from hippodrome.deployment.aws import caa, concurrency, public_access, quotas, regions
from hippodrome.deployment.aws.account import Account, other_installations, servers_domain, site_host
from hippodrome.deployment.aws.hosted_zone import delegation, exists, leading_away, read_zone, record_in
from hippodrome.deployment.core.finding import Finding, Mark, bad, examine, look, show
from hippodrome.deployment.stack import domain_change, inventory
from hippodrome.deployment.stack.changes import Prepared

if TYPE_CHECKING:
    from hippodrome.deployment.core.project_folder import ProjectFolder

FEW = 20  # if the quota allows fewer servers at once, the advice is to ask AWS for more
USUAL = 1.0  # vCPU of a server, if no study says how many


class AccountCheck(NamedTuple):
    """An account without an installation, and the study that will be registered there, if any."""

    account: Account
    study: ProjectFolder | None


def check(
    prepared: Prepared, study: ProjectFolder | None = None, wrong: Sequence[Finding] = (), *, anyway: bool = False
) -> None:
    """Check everything that is new or changes; show all findings, those in `wrong` included.

    Raises `Problem` if one of them is bad, unless `anyway`.
    """
    _stop([*wrong, *look_at(prepared, study)], anyway)


def check_account(account: Account, wrong: Sequence[Finding], study: ProjectFolder | None = None) -> None:
    """Check the account before a first installation; show all findings. Raises `Problem` if one of them is bad."""
    _stop([*wrong, *examine(AccountCheck(account, study), _OF_ACCOUNT)])


def of_problem(name: str, problem: Problem) -> Finding:
    """Make a bad finding of a problem."""
    return bad(name, "\n    ".join([str(problem), *problem.details]), problem.advice)


def look_at(prepared: Prepared, study: ProjectFolder | None = None) -> list[Finding]:
    """Make all checks that apply, and return the findings that are not good, bad ones last. Changes nothing.

    `study` is the study that will be registered in this installation.
    """
    before, after = prepared.before, prepared.parameters
    findings: list[Finding] = []
    checks: dict[str, Callable[[Prepared], Iterable[Finding]]] = {}
    if (before.get("RootDomain"), before.get("SiteHost")) != (after["RootDomain"], after["SiteHost"]):
        checks |= _OF_ADDRESSES if after["RootDomain"] else {"servers": _servers_that_run}
    if domain_change.moves(prepared) and after["RootDomain"]:
        checks |= {"CAA": _authorities, "proof": _proof, "servers' names": _servers_names}
    if (before.get("VpcId") or "") != after["VpcId"]:
        checks["servers"] = _servers_that_run
    if after["VpcId"] and (before.get("VpcId"), before.get("SubnetIds")) != (after["VpcId"], after["SubnetIds"]):
        checks["network"] = _subnets
    if prepared.existing is None or (before.get("VpcId") or "") != after["VpcId"]:
        checks["Internet"] = _internet
    if prepared.existing is None:
        checks |= {"VPCs": _vpcs, "left over": _left_over}
        findings = examine(AccountCheck(prepared.account, study), _OF_ACCOUNT)
    findings += examine(prepared, checks)
    return _bad_last(finding for finding in findings if finding.mark is not Mark.GOOD)


def _bad_last(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings with the bad ones at the end, so that long remarks do not scroll them off the screen."""
    return sorted(findings, key=lambda finding: finding.mark is Mark.BAD)


def _stop(findings: Sequence[Finding], anyway: bool = False) -> None:
    show(_bad_last(findings), screen.err)
    bads = sum(finding.mark is Mark.BAD for finding in findings)
    if bads and not anyway:
        raise Problem(
            f"{count(bads, 'thing')} {'is' if bads == 1 else 'are'} in the way, marked ✗. Nothing was made or changed.",
            "Put that right, and run the same command again.",
        )


# -- the account ------------------------------------------------------------------------------------------------------


def _region(checked: AccountCheck) -> Iterator[Finding]:
    try:
        regions.check(checked.account.region)
    except Problem as problem:
        yield of_problem("region", problem)


def _root(checked: AccountCheck) -> Iterator[Finding]:
    if checked.account.identity["Arn"].endswith(":root"):
        yield look(
            "credentials", "They are the root user's, who may do everything.", "Use a role or a user of your own."
        )


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
    "credentials": _root,
    "Lambda": _executions,
    "Fargate": _servers,
}


# -- the addresses ----------------------------------------------------------------------------------------------------


def _delegation(prepared: Prepared) -> Iterator[Finding]:
    """Check the zone's delegation. Without it the stack waits up to twelve hours for ACM, which asks DNS, and fails.

    (aws-cloudformation/cloudformation-coverage-roadmap, issue 130; ACM's user guide, "Troubleshoot DNS validation".)
    """
    zone = read_zone(prepared.account, prepared.parameters["HostedZoneId"])
    answer = delegation(zone)
    servers = ", ".join(zone.name_servers)
    if answer.problem and answer.certain:
        yield bad(
            "domain",
            f"{answer.problem} No certificate can be issued for it, and its names cannot be resolved.",
            f"Make these the name servers of {zone.domain}, where it is registered or in the zone above it: {servers}. "
            "DNS knows them after minutes or hours; then run the same command again.",
        )
    elif answer.problem:
        yield look("domain", answer.problem, f"Its name servers have to be {servers}.")


def _proof(prepared: Prepared) -> Iterator[Finding]:
    """Check that Let's Encrypt can see the zone's TXT record, by which an installation proves its servers' domain."""
    zone = read_zone(prepared.account, prepared.parameters["HostedZoneId"])
    proof = proof_name(servers_domain(prepared.parameters))
    if away := leading_away(prepared.account, zone, proof):
        name, kind = away
        yield bad(
            "domain",
            f"The zone has a record {kind} of {name}, so no authority can see the proof that the servers' domain is "
            f"yours: the TXT record {proof}.",
            "Remove that record from the zone, or take another --servers.",
        )


def _authorities(prepared: Prepared) -> Iterator[Finding]:
    """Check the CAA records, which must allow Amazon for the site and Let's Encrypt for the servers' names."""
    after = prepared.parameters
    root, site, servers = after["RootDomain"], site_host(after), names_of(servers_domain(after))
    exists_in_zone = partial(exists, prepared.account, read_zone(prepared.account, after["HostedZoneId"]))
    wanted = [("Amazon", site, caa.AMAZON), *(("Let's Encrypt", name, caa.LETS_ENCRYPT) for name in servers)]
    for issuer, name, authorities in wanted:
        caa_records, wildcard = caa.find(name.removeprefix("*."), exists_in_zone), name.startswith("*.")
        if not caa_records.certain:
            yield look(
                "CAA",
                f"DNS could not be asked which authorities may issue certificates for {name}.",
                "If the domain has no CAA records, nothing needs to be done. Otherwise try again on another network.",
            )
        elif forbidding := caa_records.forbidding(authorities, wildcard=wildcard, acme=authorities != caa.AMAZON):
            place = root if root.endswith(f".{caa_records.where}") else caa_records.where
            records = ", ".join(f'0 {tag} "{value}"' for tag, value in forbidding)
            yield bad(
                "CAA",
                f"The CAA records of {caa_records.where} ({records}) keep {issuer} "
                f"from issuing a certificate for {name}.",
                f'Add two CAA records to {place}: 0 issue "{caa.AMAZON[0]}" and 0 issuewild "{caa.LETS_ENCRYPT[0]}".',
            )


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


def _servers_names(prepared: Prepared) -> Iterator[Finding]:
    try:
        domain_change.check(prepared)
    except Problem as problem:
        yield of_problem("servers' names", problem)


def _servers_that_run(prepared: Prepared) -> Iterator[Finding]:
    """Check that no running server uses an address of the site, or a network, that is to be replaced."""
    for check in (domain_change.check_site, domain_change.check_network):
        try:
            check(prepared)
        except Problem as problem:
            yield of_problem("servers", problem)


def _other_stacks(prepared: Prepared) -> Iterator[Finding]:
    """Check for other stacks with this domain: if both had the same study, its servers would have the same names."""
    name, root = prepared.stack.name, prepared.parameters["RootDomain"]
    for other, parameters in other_installations(prepared.account, name):
        if parameters.get("RootDomain") == root:
            yield look(
                "domain",
                f"The stack {other} has the domain {root} as well: never register a project in both.",
                f"A domain of its own, below that, is safer: --domain {name.lower()}.{root}",
            )


_OF_ADDRESSES: Mapping[str, Callable[[Prepared], Iterable[Finding]]] = {
    "domain": _delegation,
    "CAA": _authorities,
    "proof": _proof,
    "site": _site,
    "servers": _servers_that_run,
    "other stacks": _other_stacks,
}


# -- the network, and what an earlier installation has left -----------------------------------------------------------


def _subnets(prepared: Prepared) -> Iterator[Finding]:
    after = prepared.parameters
    vpc, subnets = after["VpcId"], after["SubnetIds"].split(",")
    try:
        found = prepared.account.client("ec2").describe_subnets(SubnetIds=subnets)["Subnets"]
    except ClientError as error:
        if errors.code(error) not in {"InvalidSubnetID.NotFound", "InvalidSubnetId.Malformed"}:
            raise
        yield bad("network", errors.message(error), "Check --subnets and --region.")
        return
    for subnet in found:
        if subnet["VpcId"] != vpc:
            yield bad(
                "network",
                f"The subnet {subnet['SubnetId']} is in {subnet['VpcId']}, not in {vpc}.",
                "Name a VPC and its own subnets: --vpc and --subnets.",
            )
    if len({one.get("AvailabilityZone") for one in found}) < 2:
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
    if prepared.found is not None:
        return
    name = prepared.stack.name
    if log_groups := inventory.log_groups(prepared.account, name):
        yield bad(
            "left over",
            f"An earlier installation {name} has left {count(len(log_groups), 'log group')}, such as {log_groups[0]}.",
            f"Finish its removal: `hippodrome destroy --stack {name}`. The data stay.",
        )


# -- ECS's role -------------------------------------------------------------------------------------------------------


def make_ecs_role(account: Account) -> bool:
    """Make ECS's service-linked role if the account has none: without it, a template's first cluster fails.

    (aws-cloudformation/cloudformation-coverage-roadmap, issue 818.) Return whether it was made now: AWS knows it
    everywhere some seconds later (IAM's user guide, "Changes that I make are not always immediately visible").
    """
    try:
        account.client("iam").create_service_linked_role(AWSServiceName="ecs.amazonaws.com")
    except ClientError as error:
        # InvalidInput: the role exists. If these credentials may not make it, it may exist all the same.
        if errors.code(error) not in {"InvalidInput", "AccessDenied", "InvalidAction", "EntityAlreadyExists"}:
            raise
        return False
    return True
