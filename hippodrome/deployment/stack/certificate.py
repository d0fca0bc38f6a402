"""`certificate`: orders one wildcard certificate for all servers by ACME DNS-01, and stores it in the data bucket."""

# ruff: noqa: PLC0415 - the library acme is imported only to order

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import urlsplit

import typer

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.certificates.rules import (
    PRODUCTION,
    STAGING,
    Decision,
    FailureReason,
    OrderFailed,
    OrderStage,
    RenewalRequest,
    StoredCertificate,
    Verdict,
    names_of,
)
from hippodrome.deployment.aws import caa
from hippodrome.deployment.aws.account import Account, Installation, find_installation, open_account
from hippodrome.deployment.aws.hosted_zone import read_zone
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.stack import certificate_transfer, domain

if TYPE_CHECKING:
    from hippodrome.control.certificates.renewal import Renewal

REAL = "hippodrome certificate --production"
_MAX_BUNDLE = 1_000_000  # bytes


@dataclass(frozen=True)
class Choice:
    """The order that the administrator wants.

    `directory` is the ACME directory that gets the order. If it is empty, the authority of the present certificate gets
    the order; without a certificate, Let's Encrypt's staging environment.
    """

    directory: str = ""
    email: str = ""
    trusted: str = ""  # PEM of the root certificates by which the directory's TLS is checked; "": the public ones
    force: bool = False
    seconds: float = 300.0


@dataclass(frozen=True)
class Report:
    """The certificate in place, and what `certificate` decided about it."""

    domain: str
    directory: str  # the ACME directory from which the certificate in place comes; "" if unknown
    decision: Decision
    stored: StoredCertificate | None
    now: datetime
    wanted: str = ""  # the ACME directory at which a new certificate was, or would be, ordered

    @property
    def ordered(self) -> bool:
        """Whether a certificate was ordered; in a report of `inspect`, whether one would be ordered."""
        return self.decision.verdict is Verdict.ORDER

    @property
    def days_left(self) -> int | None:
        """The days for which the present certificate is valid; None if there is none."""
        return self.stored.days_left(self.now) if self.stored else None

    @property
    def for_tests(self) -> bool:
        """Whether the certificate comes from Let's Encrypt's staging environment, which browsers do not trust."""
        return bool(self.stored) and self.directory == STAGING

    def as_json(self) -> dict[str, Any]:
        """Return the report as JSON data, for scripts."""
        return {
            "domain": self.domain,
            "names": list(self.stored.names) if self.stored else [],
            "directory": self.directory,
            "trustedByBrowsers": bool(self.stored) and self.directory == PRODUCTION,
            "serial": self.stored.serial if self.stored else None,
            "notAfter": self.stored.not_after.isoformat() if self.stored else None,
            "daysLeft": self.days_left,
            "decision": self.decision.verdict.value,
            "why": self.decision.why,
            "until": self.decision.until.isoformat() if self.decision.until else None,
        }


def command(
    *,
    production: Annotated[bool, typer.Option("--production", help="Order Let's Encrypt's real certificate.")] = False,
    staging: Annotated[
        bool,
        typer.Option(
            "--staging",
            help="Order its test certificate, which browsers do not trust. Without both options, the authority of the "
            "present certificate is asked again; the first certificate is a test certificate.",
        ),
    ] = False,
    email: Annotated[str, typer.Option("--email", help="An address that the authority may write to.")] = "",
    directory: Annotated[str, typer.Option("--directory", help="Another authority: its ACME directory's URL.")] = "",
    ca_file: Annotated[
        Path | None, typer.Option("--ca-file", help="PEM file of the roots that its address is checked with.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Order although there is no need to.")] = False,
    dry_run: options.DryRun = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Get the servers' certificate, or renew it: one for *.servers.<your domain>, from Let's Encrypt.

    It proves by a DNS record in Route 53 that the domain is yours, and stores the certificate in the installation's
    bucket, where servers fetch it when they start and every hour. A function renews it by itself from then on.

    The first one is a test certificate, which does not count toward the limits for real ones; when it works, order
    with --production. --dry-run shows the present certificate and what would be done (exit code 3: something).
    """
    choice = Choice(_directory(production, staging, directory), email.strip(), _bundle(ca_file), force)
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    if not installation.has_domain:
        screen.result("This installation has no domain: each server gets a certificate for its own address by itself.")
        return Exit.DONE
    if not dry_run:
        certificate_transfer.take_over(account, installation)
    report = inspect(account, installation, choice) if dry_run else obtain_visibly(account, installation, choice)
    if as_json:
        screen.result_json(report.as_json())
    else:
        _show(report, dry_run)
    return Exit.CHANGES if dry_run and report.ordered else Exit.DONE


def inspect(account: Account, installation: Installation, choice: Choice = Choice()) -> Report:
    """Report the certificate in place and what `obtain` would do. Changes nothing. Raises `Problem` as `check` does."""
    renewal, wish = renewal_of(account, installation, choice, lambda _: None)
    decision = renewal.decide(wish)
    if decision.verdict is Verdict.ORDER:
        check(account, installation, wish.directory, own=bool(wish.trusted))
    stored = renewal.read()[1]
    return Report(wish.domain, stored.directory if stored else "", decision, stored, datetime.now(UTC), wish.directory)


def obtain(
    account: Account,
    installation: Installation,
    choice: Choice = Choice(),
    *,
    tell: Callable[[OrderStage], None] = lambda _: None,
) -> Report:
    """Order a certificate if one is due. Raises `Problem` if that fails; then the present certificate stays."""
    renewal, wish = renewal_of(account, installation, choice, tell)
    if renewal.decide(wish).verdict is Verdict.ORDER:
        check(account, installation, wish.directory, own=bool(wish.trusted))
    try:
        outcome = renewal.obtain(wish)
    except OrderFailed as error:
        raise _problem(error, wish) from error
    if outcome.decision.verdict not in {Verdict.ORDER, Verdict.FRESH}:
        raise _obstacle(outcome.decision, outcome.stored)
    directory = outcome.stored.directory if outcome.stored else ""
    return Report(wish.domain, directory, outcome.decision, outcome.stored, datetime.now(UTC), wish.directory)


def obtain_visibly(account: Account, installation: Installation, choice: Choice) -> Report:
    """Call `obtain`, and show a progress bar."""
    with screen.ProgressBars() as bar:
        which = {STAGING: "test ", PRODUCTION: "real "}.get(choice.directory, "")
        task = bar.add_task(f"Looking at the {which}certificate", total=len(OrderStage))

        def tell(stage: OrderStage) -> None:
            bar.update(task, description=stage.value, completed=list(OrderStage).index(stage))

        report = obtain(account, installation, choice, tell=tell)
        bar.update(task, description="Certificate", completed=len(OrderStage))
    return report


def renewal_of(
    account: Account, installation: Installation, choice: Choice, tell: Callable[[OrderStage], None]
) -> tuple[Renewal, RenewalRequest]:
    """Make the service that renews the installation's certificate, and the request to it for this choice."""
    from hippodrome.control.certificates.renewal import Renewal

    platform = account.platform(installation)
    renewal = Renewal(
        platform.documents,
        platform.challenges,
        platform.now,
        installation.certificate,
        tell=tell,
        note=lambda text, error: screen.warning(f"{text[:1].upper()}{text[1:]} ({type(error).__name__})."),
    )
    directory = choice.directory or renewal.last_directory() or STAGING
    trusted = choice.trusted or renewal.last_roots(directory)
    return renewal, RenewalRequest(
        installation.servers_domain, directory, choice.email, trusted, choice.force, choice.seconds
    )


# ---- before an order


def check(account: Account, installation: Installation, directory: str, own: bool = False) -> None:
    """Raise `Problem` if the domain is not in the zone, the zone is not delegated, or a record forbids the order.

    `own` says that the directory belongs to an authority of one's own, which may use another DNS. Then only the zone is
    checked. If DNS cannot be asked about the delegation, this only warns.
    """
    servers = installation.servers_domain
    zone = read_zone(account, installation["HostedZoneId"])
    if not zone.holds(servers):
        raise Problem(
            f"The hosted zone {zone.id} is for {zone.domain}, and {servers} does not lie in it.",
            "Give the zone of your domain: `hippodrome deploy --no-study --zone …`.",
        )
    if own:
        return
    for finding in domain.look_at(account, zone, servers, any_caa=directory not in (PRODUCTION, STAGING)):
        if finding.mark is Mark.BAD:
            raise Problem(finding.text, finding.advice)
        screen.warning(finding.text)


# ---- the options


def _directory(production: bool, staging: bool, directory: str) -> str:
    if bool(directory) + production + staging > 1:
        raise Problem("--production, --staging and --directory each name an authority.", "Give one of them.")
    if directory and not directory.startswith("https://"):
        raise Problem(f"{directory!r} is no ACME directory.", "It is an address that begins with https:// (RFC 8555).")
    return directory or (PRODUCTION if production else STAGING if staging else "")


def _bundle(path: Path | None) -> str:
    if path is None:
        return ""
    try:
        text = path.read_text() if path.stat().st_size <= _MAX_BUNDLE else ""
    except (OSError, UnicodeDecodeError):
        text = ""
    if "-----BEGIN CERTIFICATE-----" not in text:
        raise Problem(f"{path} cannot be read as a PEM file of certificates.", "Check what --ca-file names.")
    return text


# ---- the messages


def _show(report: Report, dry_run: bool) -> None:
    stored, decision = report.stored, report.decision
    if stored and not dry_run and report.ordered:
        screen.success(f"A new certificate for {', '.join(stored.names)} is in place until {_day(stored.not_after)}.")
    elif stored:
        days_left = report.days_left or 0
        when = f"{days_left} days left" if stored.not_after > report.now else "it has expired"
        names = ", ".join(stored.names) or "nothing that can be read"
        screen.result(f"Certificate for {names}: until {_day(stored.not_after)}, {when}.")
    else:
        screen.result("There is no certificate yet.")
    if dry_run and report.ordered:
        screen.result(f"A new one would be ordered for {', '.join(names_of(report.domain))}: {decision.why}.")
    elif decision.verdict is Verdict.FRESH and decision.until:
        screen.result(f"Nothing to do; it renews itself from {_day(decision.until)}.")
    elif not report.ordered:
        screen.result(f"Nothing would be ordered{_until(decision.until)}: {decision.why}.")
    if report.for_tests:
        screen.warning("This is a test certificate: browsers do not trust it, and no participant can play.")
        screen.warning(f"Get a real one: {REAL}")
    elif dry_run and not stored and report.wanted == STAGING:
        screen.info(f"The first is a test certificate, unless you ask for a real one: {REAL}")


def _obstacle(decision: Decision, stored: StoredCertificate | None) -> Problem:
    """Explain why a certificate that is needed was not ordered."""
    if decision.verdict is Verdict.FOREIGN:
        until = f", valid until {_day(stored.not_after)}" if stored and stored.not_after > datetime.now(UTC) else ""
        return Problem(
            f"The certificate in SSL/ was put there by hand{until or ', and has expired'}.",
            "It stays until you say --force; then this command replaces it, and renews it from then on.",
        )
    if decision.verdict is Verdict.BUSY:
        return Problem(
            "Another run is ordering a certificate at the moment, or was killed while it did.",
            f"Wait{_until(decision.until)}; if you know that none runs, add --force.",
        )
    return Problem(
        f"Nothing is ordered{_until(decision.until)}: {decision.why}.",
        "The authority allows only a few failures an hour. Remove the cause, then wait, or add --force.",
    )


def _problem(error: OrderFailed, wish: RenewalRequest) -> Problem:
    authority, message = _authority(wish.directory), str(error)
    caa_name = caa.LETS_ENCRYPT[0] if wish.directory in (PRODUCTION, STAGING) else "<the authority>"
    sentences: dict[FailureReason, tuple[str, str]] = {
        FailureReason.VALIDATION: (
            f"{authority} could not see the proof in DNS.",
            f"Check that {wish.domain} leads to its hosted zone (`hippodrome doctor --all`), and run this again.",
        ),
        FailureReason.CAA: (
            f"A CAA record of {wish.domain}, or of a domain above it, forbids {authority} to issue.",
            f'Add the record 0 issuewild "{caa_name}" and run this again.',
        ),
        FailureReason.RATE_LIMITED: (
            f"{authority} wants no further orders{_until(error.until)}.",
            "Wait; the certificate in place stays. Tests are better done with --staging.",
        ),
        FailureReason.DNS: (
            "The proof could not be published in DNS.",
            "Look at that record in Route 53, and run this again.",
        ),
        FailureReason.REFUSED: (
            f"{authority} refuses the order.",
            "Read its message; its terms may forbid this domain.",
        ),
        FailureReason.UNREACHABLE: (
            f"{authority} cannot be reached just now.",
            "Check the network, and run this again later.",
        ),
        FailureReason.TIMEOUT: (f"The order at {authority} took too long.", "Run this again; nothing is lost."),
        FailureReason.WRONG: (
            f"What came from {authority} is not what was ordered, so it was not stored.",
            "Run this again.",
        ),
        FailureReason.OVERTAKEN: (
            "Another run was faster.",
            "See what there is now: `hippodrome certificate --dry-run`.",
        ),
        FailureReason.BROKEN: (f"{authority} could not be understood.", "Is that the address of an ACME directory?"),
    }
    text, advice = sentences[error.reason]
    return Problem(text, advice, [message] if message else ())


def _authority(directory: str) -> str:
    names = {PRODUCTION: "Let's Encrypt", STAGING: "Let's Encrypt (staging)"}
    return names.get(directory) or f"The certificate authority {urlsplit(directory).hostname}"


def _until(until: datetime | None) -> str:
    return f" until {until.astimezone():%Y-%m-%d %H:%M}" if until else ""


def _day(at: datetime) -> str:
    return f"{at.astimezone():%Y-%m-%d}"
