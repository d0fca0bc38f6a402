"""Checks and prepares a change of an installation's domain of servers, site or network.

None of these changes while a server runs. Servers get new names only when there is a certificate for them.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from datetime import UTC, datetime

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.certificates.rules import Verdict
from hippodrome.control.model.server import Server
from hippodrome.deployment.aws.account import Account, Installation, other_installations, servers_domain, site_host
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.stack import certificate
from hippodrome.deployment.stack.certificate import Choice
from hippodrome.deployment.stack.changes import Prepared

_WAIT = (
    "Wait until they have ended, or end them with `hippodrome stop --all`; then apply again. Warm servers end for good "
    "when their study is closed (`hippodrome register --no-live`)."
)


def moves(prepared: Prepared) -> bool:
    """Whether this apply moves servers' names to another domain. It is True, too, if there is no installation yet."""
    before = _before(prepared)
    return before is None or before.servers_domain != servers_domain(prepared.parameters)


def check(prepared: Prepared) -> None:
    """Raise `Problem` if servers must not have names in the domain of the new parameters. Changes nothing."""
    if not moves(prepared):
        return
    before, after = _before(prepared), servers_domain(prepared.parameters)
    if after:
        _must_not_be_delegated(prepared.account, prepared.parameters["HostedZoneId"], after)
        _must_not_cover_a_site(prepared, after)
    if before is not None and before.has_domain:  # servers without names keep their addresses
        _refuse(
            _running(prepared.account, before),
            f"Servers run below {before.servers_domain}. No page could reach them, and their names would stay.",
        )


def check_site(prepared: Prepared) -> None:
    """Raise `Problem` if the site's name changes while a server runs.

    A domain name of API Gateway can only be replaced, so CloudFormation deletes the old one, and with it the address of
    the pages that participants have open. The API's own address stays, with and without a domain.
    """
    before, site = _before(prepared), site_host(prepared.before)
    if before is None or not before.has_domain or site == site_host(prepared.parameters):
        return
    _refuse(
        _running(prepared.account, before),
        f"Participants are playing, and their pages are at {site}, which would be gone.",
    )


def check_network(prepared: Prepared) -> None:
    """Raise `Problem` if another network replaces the present one and a server runs there.

    CloudFormation would delete the route to the Internet that the servers use, and then fail to delete the rest.
    """
    before = _before(prepared)
    if before is None or (prepared.before.get("VpcId") or "") == prepared.parameters["VpcId"]:
        return
    _refuse(
        _running(prepared.account, before),
        "Servers run in the present network. It could not be removed, and they would lose their way out of it.",
    )


def _refuse(running: Collection[Server], why: str) -> None:
    """Raise `Problem` if any server runs."""
    if running:
        raise Problem(why, _WAIT, [f"{len(running)} of them"])


def certify(prepared: Prepared) -> None:
    """Obtain a certificate for servers' new names before any server has such a name. Raises `Problem` if that fails.

    If the present names have no certificate, nothing is ordered here; `certificate` orders one later.
    """
    before = _before(prepared)
    if before is None or not before.has_domain or not moves(prepared) or not prepared.parameters["RootDomain"]:
        return
    changed = {key: prepared.parameters.get(key, "") for key in ("RootDomain", "ServersHost", "HostedZoneId")}
    after = replace(before, outputs={**before.outputs, **changed})
    renewal, wish = certificate.renewal_of(prepared.account, before, Choice(), lambda _: None)
    stored = renewal.read()[1]
    if stored is None:
        return
    if not stored.directory:
        _must_be_uploaded(prepared.account, after)
        return
    choice = Choice(wish.directory, trusted=wish.trusted)
    try:
        if certificate.inspect(prepared.account, after, choice).decision.verdict is not Verdict.FRESH:
            screen.info(f"Servers get their names below {after.servers_domain}: a certificate for those comes first.")
            certificate.obtain_visibly(prepared.account, after, choice)
    except Problem as problem:
        raise Problem(
            f"The stack stays as it was: there is no certificate for names below {after.servers_domain}. {problem}",
            problem.advice or "Run the same command again.",
            problem.details,
        ) from None


def _must_be_uploaded(account: Account, after: Installation) -> None:
    """Raise `Problem` unless the administrator, who uploads certificates by hand, has one for the new names."""
    if account.platform(after).documents.get(after.certificate.privkey) is None:
        raise Problem(
            f"The servers' certificate was put there by hand, and there is none for *.{after.servers_domain}.",
            f"Upload {after.certificate.privkey} and {after.certificate.fullchain} into the bucket {after['Bucket']}, "
            "and apply again.",
        )


def _before(prepared: Prepared) -> Installation | None:
    """Return the present installation; None if there is none, or it is not complete."""
    if prepared.existing is None:
        return None
    installation = Installation.of(prepared.account, prepared.existing)
    try:
        return installation if installation.env else None
    except Problem:
        return None


def _running(account: Account, installation: Installation) -> list[Server]:
    platform = account.platform(installation)
    return Records(platform.documents).open(platform.settings.max_runtime, datetime.now(UTC))


def _must_not_be_delegated(account: Account, zone: str, domain: str) -> None:
    """Raise `Problem` if the zone delegates this domain, since the zone's records for it are not used then."""
    records = account.client("route53").list_resource_record_sets(
        HostedZoneId=zone, StartRecordName=f"{domain}.", StartRecordType="NS", MaxItems="1"
    )
    for record in records["ResourceRecordSets"]:
        if record["Type"] == "NS" and record["Name"].rstrip(".").lower() == domain:
            raise Problem(
                f"Names below {domain} are answered elsewhere: the zone delegates them.",
                "Take another level for the servers: --servers.",
            )


def _must_not_cover_a_site(prepared: Prepared, domain: str) -> None:
    """Raise `Problem` if the servers' certificate of one installation would be valid for the site of another.

    Every agent can read the key of the servers' certificate.
    """
    ours = prepared.parameters["RootDomain"]
    for name, theirs in other_installations(prepared.account, prepared.stack.name):
        if "ServersHost" in theirs and (theirs["RootDomain"] == domain or servers_domain(theirs) == ours):
            raise Problem(
                f"The servers' certificate of one installation would be for the site of the other: this one and "
                f"{name}.",
                "Take another --domain or another --servers.",
            )
