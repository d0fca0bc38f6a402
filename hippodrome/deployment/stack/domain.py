"""Checks of a domain before a certificate is ordered for it: why no authority would issue one, or not for hours."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from hippodrome.control.certificates.rules import names_of, proof_name
from hippodrome.deployment.aws import caa
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.hosted_zone import Zone, delegation, exists, leading_away
from hippodrome.deployment.core.finding import Finding, bad, look


def look_at(account: Account, zone: Zone, servers: str, site: str = "", *, any_caa: bool = False) -> Iterator[Finding]:
    """Check the zone's delegation, and the records that hide the proof for the servers' domain or forbid certificates.

    Let's Encrypt has to be allowed to issue for the servers' names, and Amazon for `site`, if it is not "". With
    `any_caa` CAA records are not asked for, since another authority issues.
    """
    yield from _delegation(zone)
    proof = proof_name(servers)
    if away := leading_away(account, zone, proof):
        name, kind = away
        yield bad(
            "domain",
            f"The hosted zone has a record {kind} of {name}, so no authority can see the proof that the servers' "
            f"domain is yours: the TXT record {proof}.",
            "Remove that record from the zone, or take another --servers.",
        )
    if not any_caa:
        yield from _authorities(account, zone, servers, site)


def _delegation(zone: Zone) -> Iterator[Finding]:
    """Compare the zone with DNS. Without a delegation the stack waits up to twelve hours for ACM, and fails.

    (aws-cloudformation/cloudformation-coverage-roadmap, issue 130; ACM's user guide, "Troubleshoot DNS validation".)
    """
    answer, servers = delegation(zone), ", ".join(zone.name_servers)
    if answer.problem and answer.certain:
        yield bad(
            "domain",
            f"{answer.problem} No certificate can be issued for it, and its names cannot be resolved.",
            f"At the registrar of {zone.domain} (or in the zone above it), enter these name servers: {servers}. DNS "
            "knows them after minutes or hours; then run the same command again.",
        )
    elif answer.problem:
        yield look("domain", answer.problem, f"Its name servers have to be {servers}.")


def _authorities(account: Account, zone: Zone, servers: str, site: str) -> Iterator[Finding]:
    """Check the CAA records: Let's Encrypt would refuse an order that they forbid, and count it as a failure."""
    wanted = [("Let's Encrypt", name, caa.LETS_ENCRYPT) for name in names_of(servers)]
    for issuer, name, authorities in [*([("Amazon", site, caa.AMAZON)] if site else []), *wanted]:
        records, wildcard = caa.find(name.removeprefix("*."), partial(exists, account, zone)), name.startswith("*.")
        if not records.certain:
            yield look(
                "CAA",
                f"DNS could not be asked which authorities may issue certificates for {name}.",
                "If the domain has no CAA records, nothing needs to be done. Otherwise try again on another network.",
            )
        elif forbidding := records.forbidding(authorities, wildcard=wildcard, acme=authorities != caa.AMAZON):
            root = site.partition(".")[2]
            place = root if root.endswith(f".{records.where}") else records.where
            listed = ", ".join(f'0 {tag} "{value}"' for tag, value in forbidding)
            yield bad(
                "CAA",
                f"The CAA records of {records.where} ({listed}) keep {issuer} from issuing a certificate for {name}.",
                f'Add two CAA records to {place}: 0 issue "{caa.AMAZON[0]}" and 0 issuewild "{caa.LETS_ENCRYPT[0]}".',
            )
