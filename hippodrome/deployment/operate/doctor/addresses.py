"""Checks names and certificates: whether participants reach the site and the servers."""

from __future__ import annotations

import socket
import ssl
import urllib.error
import urllib.request
from collections.abc import Iterator

import certifi

from hippodrome.console.problem import Problem
from hippodrome.control.certificates.rules import (
    ADDRESS_ORDERS,
    MAX_ORDERS,
    MAX_ORDERS_AT_START,
    AddressOrders,
    names_of,
)
from hippodrome.control.storage.compare_and_swap import SharedDocuments
from hippodrome.deployment.aws import public_access
from hippodrome.deployment.aws.hosted_zone import read_zone
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.operate import snapshot
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.stack.stack import Stack

DOMAIN = "With a domain there is no such limit: `hippodrome deploy --no-study --domain …`."
PATIENCE = 10  # seconds to wait for the site


def zone(context: CheckContext) -> Iterator[Finding]:
    """Check whether the hosted zone exists, is for the domain, and is delegated."""
    domain = context.installation["RootDomain"]
    if not domain:
        return
    try:
        zone = read_zone(context.account, context.installation["HostedZoneId"])
    except Problem as problem:
        advice = "The servers' names are written there: run `hippodrome deploy --no-study` with --zone."
        yield bad("hosted zone", str(problem), advice)
        return
    if not zone.holds(domain):
        text = f"{zone.id} is for {zone.domain}, not for {domain}."
        yield bad("hosted zone", text, "Give `hippodrome deploy --no-study` its --zone.")
        return
    if context.delegation is None:
        yield good("hosted zone", f"{zone.domain} ({zone.id}); DNS was not asked.")
        return
    answer = context.delegation(zone)
    servers = ", ".join(zone.name_servers)
    if not answer.problem:
        yield good("hosted zone", f"{zone.domain} is delegated to Route 53 ({zone.id}).")
    elif answer.certain:
        yield bad("hosted zone", answer.problem, f"At the domain's registrar, make these its name servers: {servers}.")
    else:
        yield look("hosted zone", answer.problem, f"The name servers have to be {servers}.")


def site_certificate(context: CheckContext) -> Iterator[Finding]:
    """Check the site's certificate, which ACM renews by itself if DNS is right."""
    stack = Stack(context.account, context.installation.stack)
    arns = stack.ids_of("AWS::CertificateManager::Certificate")
    if not arns and context.installation.has_domain:
        yield look("site certificate", "The stack has none.", "Bring it up to date with `hippodrome deploy`.")
    for arn in arns:
        certificate = context.account.client("acm").describe_certificate(CertificateArn=arn)["Certificate"]
        status, name = certificate["Status"], certificate["DomainName"]
        if status == "ISSUED":
            yield good("site certificate", f"{name}: issued.")
        elif status == "PENDING_VALIDATION":
            advice = "It is issued as soon as the domain is delegated to the hosted zone."
            yield bad("site certificate", f"{name}: waits for its validation in DNS.", advice)
        else:
            advice = "See it in the ACM console, then run `hippodrome deploy`."
            yield bad("site certificate", f"{name}: {status}.", advice)


def site(context: CheckContext) -> Iterator[Finding]:
    """Check whether the site answers at the participants' address."""
    if context.fetch is None:
        return
    address = context.installation["Site"]
    try:
        status = context.fetch(f"{address}/next")
    except OSError as error:
        reason = getattr(error, "reason", type(error).__name__)  # of a URLError
        why = "DNS does not know it" if isinstance(reason, socket.gaierror) else reason
        yield bad("site", f"{address} cannot be reached: {why}.", "Look at the hosted zone and its certificate.")
        return
    if status >= 500:
        yield bad("site", f"{address} answers {status}.", "See `hippodrome logs --all --function next_step --errors`.")
    else:
        yield good("site", f"{address} answers.")


def internet(context: CheckContext) -> Iterator[Finding]:
    """Check whether a setting of the account closes the servers' network to the Internet."""
    stack = Stack(context.account, context.installation.stack)
    vpc = context.installation.parameters.get("VpcId") or "".join(stack.ids_of("AWS::EC2::VPC"))
    if problem := public_access.blocked(context.account, vpc, context.installation["Subnets"].split(",")):
        yield bad("Internet", str(problem), problem.advice)
    else:
        yield good("Internet", "The account does not block it for the servers' network.")


def fetch(address: str) -> int:
    """Send a GET request to an https address, and return the status, also 4xx and 5xx. Raises OSError."""
    try:
        with urllib.request.urlopen(address, timeout=PATIENCE, context=authorities()) as answer:  # noqa: S310 - https  # nosec B310
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def authorities() -> ssl.SSLContext:
    """Make a TLS context that trusts this machine's authorities and Mozilla's, which certifi has.

    Python from python.org has no authorities on macOS (its `Install Certificates.command` adds certifi's). A network
    that inspects TLS has an authority that only its machines know.
    """
    context = ssl.create_default_context()
    context.load_verify_locations(certifi.where())
    return context


def _address_orders(context: CheckContext) -> Finding:
    shared = SharedDocuments(context.platform.documents)
    orders = shared.read(ADDRESS_ORDERS, AddressOrders)
    placed = f"{orders.count(context.now)} certificates for servers' addresses were ordered in the last three hours"
    limit = f"{placed}; Let's Encrypt allows {MAX_ORDERS}, and one more every 36 seconds."
    if orders.until and context.now < orders.until:
        return bad("certificates", f"Let's Encrypt takes no orders until {orders.until:%d %B %Y, %H:%M} UTC.", DOMAIN)
    if not orders.allows(context.now, MAX_ORDERS_AT_START):
        return bad("certificates", f"{limit} No server starts.", DOMAIN)
    if context.at_once > MAX_ORDERS_AT_START - orders.count(context.now):
        return look("certificates", limit, DOMAIN)
    return good("certificates", limit)


def certificate(context: CheckContext) -> Iterator[Finding]:
    """Check whether the servers' wildcard certificate is in place, valid, and renewed in time.

    Without a domain, check whether the authority still takes orders for servers' addresses.
    """
    if not context.installation.has_domain:
        yield _address_orders(context)
        return
    order = "Order one: `hippodrome certificate --production`."
    try:
        certificate = snapshot.certificate(context.installation, context.platform.documents, context.now)
    except Problem as problem:
        yield bad("certificate", str(problem), order)
        return
    if certificate is None:
        yield bad("certificate", "There is none: no browser can reach a server.", order)
        return
    (expected,) = names_of(context.installation.servers_domain)
    if expected not in certificate.names:
        yield bad("certificate", f"It is for {', '.join(certificate.names) or 'no name'}, not for {expected}.", order)
    elif certificate.days_left < 0 or certificate.expires <= context.now:
        yield bad("certificate", f"It expired on {certificate.expires:%d %B %Y}.", order)
    elif certificate.staging:
        yield bad("certificate", "It comes from a staging authority: browsers refuse it.", order)
    elif certificate.urgent(context.now):
        text = f"{certificate.days_left} days left, and it was not renewed."
        yield bad("certificate", text, f"{order} See `hippodrome logs --all --function renew_certificate --errors`.")
    elif certificate.overdue(context.now):
        text = f"{certificate.days_left} days left: it should be renewed by now."
        yield look("certificate", text, "See `hippodrome logs --all --function renew_certificate`.")
    else:
        yield good("certificate", f"{', '.join(certificate.names)}: {certificate.days_left} days left.")
