"""Finds the hosted zone of a domain, reads its records, and compares it with what the Internet's DNS says."""

# ruff: noqa: PLC0415 - dnspython is imported where DNS is asked: few commands ask it

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import Account

if TYPE_CHECKING:
    import dns.resolver

DNS_TIMEOUT = 4.0  # seconds, all tries together

_DOMAIN = re.compile(r"(?=.{4,200}$)([a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?\.)+[a-z][a-z0-9-]{0,61}[a-z0-9]")
_ID = re.compile(r"[A-Z0-9]{1,32}")


@dataclass(frozen=True)
class Zone:
    """A public hosted zone: its id, its domain without the final dot, and the name servers that Route 53 gave it."""

    id: str
    domain: str
    name_servers: tuple[str, ...]

    def holds(self, domain: str) -> bool:
        """Whether records of this domain belong into the zone."""
        return domain == self.domain or domain.endswith(f".{self.domain}")


def clean_domain(domain: str) -> str:
    """Write the domain in lower case and without a final dot. Raises `Problem` if it is no domain."""
    name = domain.strip().rstrip(".").lower()
    if not _DOMAIN.fullmatch(name):
        raise Problem(f"{domain!r} is not a domain.", "Give one such as example.org.")
    return name


def find_zone(account: Account, domain: str) -> Zone:
    """Find the public zone of the domain or, if it has none of its own, of the nearest domain above it.

    Raises `Problem` if there is none, or if several zones have that name.
    """
    public: dict[str, list[str]] = {}
    private: set[str] = set()
    for page in account.client("route53").get_paginator("list_hosted_zones").paginate():
        for zone in page["HostedZones"]:
            name = zone["Name"].rstrip(".").lower()
            if zone.get("Config", {}).get("PrivateZone"):
                private.add(name)
            else:
                public.setdefault(name, []).append(zone["Id"].rsplit("/", 1)[-1])
    parts = domain.split(".")
    for start in range(len(parts) - 1):
        name = ".".join(parts[start:])
        if len(public.get(name, ())) > 1:
            raise Problem(
                f"This account has {len(public[name])} public hosted zones for {name}.",
                "Delete the zones that the domain is not delegated to, or name the right zone with --zone.",
                public[name],
            )
        if name in public:
            return read_zone(account, public[name][0])
    raise Problem(
        f"This account has no public hosted zone for {domain}{' (only a private one)' if domain in private else ''}.",
        "Make one in Route 53 and delegate the domain to it, or check --profile; it has: "
        + (", ".join(sorted(public)) or "none")
        + ".",
    )


def read_zone(account: Account, zone_id: str) -> Zone:
    """Read a zone by its id. Raises `Problem` if there is none with that id, or if it is private."""
    if not _ID.fullmatch(zone_id):
        raise Problem(f"{zone_id!r} is not the id of a hosted zone.", "They look like Z0123456789ABCDEFGHIJ.")
    client = account.client("route53")
    try:
        zone = client.get_hosted_zone(Id=zone_id)
    except (client.exceptions.NoSuchHostedZone, client.exceptions.InvalidInput):
        raise Problem(
            f"This account has no hosted zone {zone_id}.", "`aws route53 list-hosted-zones` lists its zones."
        ) from None
    if zone["HostedZone"].get("Config", {}).get("PrivateZone"):
        raise Problem(
            f"The hosted zone {zone_id} is private: participants could not find anything in it.",
            "Give the id of the domain's public zone.",
        )
    servers = zone.get("DelegationSet", {}).get("NameServers", [])
    return Zone(
        zone_id, zone["HostedZone"]["Name"].rstrip("."), tuple(sorted(server.rstrip(".") for server in servers))
    )


def record_in(account: Account, zone: Zone, name: str) -> dict[str, Any] | None:
    """Return the zone's A, AAAA or CNAME record of `name`; None if there is none."""
    records = account.client("route53").list_resource_record_sets(
        HostedZoneId=zone.id, StartRecordName=f"{name}.", MaxItems="10"
    )
    for record in records["ResourceRecordSets"]:
        if record["Name"].rstrip(".").lower() == name and record["Type"] in {"A", "AAAA", "CNAME"}:
            return dict(record)
    return None


def leading_away(account: Account, zone: Zone, name: str) -> tuple[str, str] | None:
    """Return the name and type of a record by which nobody can see a TXT record of this name; None if there is none.

    It is an NS record of the name, or of a name above it: those who ask for the name are sent to other name servers. Or
    it is a CNAME record of the name, beside which Route 53 takes no other record.
    """
    labels = name.removesuffix(f".{zone.domain}").split(".")
    for above in (f"{'.'.join(labels[n:])}.{zone.domain}" for n in range(len(labels))):
        records = account.client("route53").list_resource_record_sets(
            HostedZoneId=zone.id, StartRecordName=f"{above}.", MaxItems="10"
        )
        for record in records["ResourceRecordSets"]:
            types = {"NS", "CNAME"} if above == name else {"NS"}
            if record["Name"].rstrip(".").lower() == above and record["Type"] in types:
                return above, record["Type"]
    return None


def exists(account: Account, zone: Zone, name: str) -> bool:
    """Whether a name in the zone exists: it or a name below it has records, or a wildcard record matches it.

    This asks Route 53, not DNS: a resolver that is asked for a name before the name is made answers for 15 minutes
    that there is none (RFC 2308, section 5; Route 53 Developer Guide, "The start of authority (SOA) record": the TTL
    of 900 seconds counts). A name outside of the zone counts as existing.
    """
    if not zone.holds(name) or name == zone.domain:
        return True
    labels = name.removesuffix(f".{zone.domain}").split(".")
    wildcards = [f"*.{'.'.join([*labels[n:], zone.domain])}" for n in range(1, len(labels) + 1)]
    return any(_has_records(account, zone, wildcard) for wildcard in (name, *wildcards))


def _has_records(account: Account, zone: Zone, name: str) -> bool:
    """Whether the zone has a record of this name or of a name below it.

    One record tells: in Route 53's order, the names below a name come next after it.
    """
    records = account.client("route53").list_resource_record_sets(
        HostedZoneId=zone.id, StartRecordName=f"{name}.", MaxItems="1"
    )
    names = [record["Name"].replace(r"\052", "*").rstrip(".").lower() for record in records["ResourceRecordSets"]]
    return any(record_name == name or record_name.endswith(f".{name}") for record_name in names)


@dataclass(frozen=True)
class Delegation:
    """The name servers that the Internet's DNS has for a zone. `problem` is "" if they are Route 53's."""

    found: tuple[str, ...]
    problem: str = ""
    certain: bool = True  # False: DNS could not be asked


def delegation(zone: Zone) -> Delegation:
    """Ask the Internet's DNS for the zone's name servers. Never raises; takes some seconds at most."""
    import dns.exception
    import dns.resolver

    dns_resolver = resolver()
    try:
        answer = dns_resolver.resolve(zone.domain, "NS")
    except (dns.resolver.NXDOMAIN, dns.resolver.NoAnswer):
        return Delegation((), f"The Internet knows no name servers for {zone.domain}.")
    except dns.resolver.NoNameservers:
        certain = _answers(dns_resolver, zone.domain.partition(".")[2])
        return Delegation((), f"The name servers that {zone.domain} is delegated to do not answer for it.", certain)
    except (dns.exception.DNSException, OSError, ValueError) as error:
        return Delegation((), f"Whether {zone.domain} is delegated could not be asked: {type(error).__name__}.", False)
    servers = tuple(sorted(str(target.target).rstrip(".").lower() for target in answer))
    if zone.name_servers and not set(servers) & {name_server.lower() for name_server in zone.name_servers}:
        return Delegation(servers, f"{zone.domain} is delegated to other name servers: {', '.join(servers)}.")
    return Delegation(servers)


def resolver() -> dns.resolver.Resolver:
    """Make a resolver with this machine's configuration, which gives up after `DNS_TIMEOUT`."""
    import dns.resolver

    dns_resolver = dns.resolver.Resolver(configure=True)
    dns_resolver.lifetime = DNS_TIMEOUT
    return dns_resolver


def _answers(dns_resolver: dns.resolver.Resolver, domain: str) -> bool:
    """Whether the resolver answers for `domain`. If it does not, its failure for a domain below proves nothing."""
    import dns.exception
    import dns.resolver

    try:
        dns_resolver.resolve(f"{domain}.", "NS")
    except (dns.resolver.NXDOMAIN, dns.resolver.NoAnswer):
        return True
    except (dns.exception.DNSException, OSError, ValueError):
        return False
    return True
