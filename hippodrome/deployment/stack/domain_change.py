"""A change of the servers' domain: servers get new names only when there is a certificate for them."""

from __future__ import annotations

from dataclasses import replace

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.certificates.rules import Verdict
from hippodrome.deployment.aws.account import Installation, servers_domain
from hippodrome.deployment.stack import certificate
from hippodrome.deployment.stack.certificate import Choice
from hippodrome.deployment.stack.changes import Prepared


def present(prepared: Prepared) -> Installation | None:
    """Return the present installation; None if there is none, or it is not complete."""
    if prepared.existing is None:
        return None
    installation = Installation.of(prepared.account, prepared.existing)
    try:
        return installation if installation.env else None
    except Problem:
        return None


def moves(prepared: Prepared) -> bool:
    """Whether servers' names move to another domain. It is True, too, if there is no installation yet."""
    return not prepared.before or servers_domain(prepared.before) != servers_domain(prepared.parameters)


def certify(prepared: Prepared) -> None:
    """Obtain a certificate for servers' new names before any server has such a name. Raises `Problem` if that fails.

    If the present names have no certificate, nothing is ordered here; `certificate` orders one later.
    """
    before = present(prepared)
    if before is None or not before.has_domain or not moves(prepared) or not prepared.parameters["RootDomain"]:
        return
    changed = {key: prepared.parameters.get(key, "") for key in ("RootDomain", "ServersHost", "HostedZoneId")}
    after = replace(before, outputs={**before.outputs, **changed})
    renewal, wish = certificate.renewal_of(prepared.account, before, Choice(), lambda _: None)
    stored = renewal.read()[1]
    if stored is None:
        return
    if not stored.directory:  # uploaded by hand
        if prepared.account.platform(after).documents.get(after.certificate.privkey) is None:
            raise Problem(
                f"The servers' certificate was put there by hand, and there is none for *.{after.servers_domain}.",
                f"Upload {after.certificate.privkey} and {after.certificate.fullchain} into the bucket "
                f"{after['Bucket']}, and deploy again.",
            )
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
