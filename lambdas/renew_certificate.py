"""Timer, daily: order the servers' certificate anew when it is due, from where it came."""

from __future__ import annotations

from typing import Any, cast

from hippodrome.aws import AwsPlatform
from hippodrome.certificates.renewal import Renewal, renew
from hippodrome.certificates.rules import location
from hippodrome.log import failure, logger
from lambdas import installed

LONGEST = 480.0  # seconds for an order; it usually takes one to two minutes
MARGIN = 60.0  # seconds for the end: a request under way, the TXT record, the state


def handler(event: dict[str, Any], context: Any) -> dict[str, str]:
    """Scheduled event → what was done. Raises if an order fails: the alarm for errors watches that."""
    platform = cast(AwsPlatform, installed.platform())  # this function runs nowhere else
    domain = platform.settings.servers_domain
    left = context.get_remaining_time_in_millis() / 1000 if context else LONGEST + MARGIN
    renewal = Renewal(
        platform.documents,
        platform.challenges,
        platform.now,
        location(domain, platform.settings.root_domain),
        tell=lambda stage: logger.info("certificate", extra={"stage": stage.value}),
        note=failure,
    )
    outcome = renew(renewal, domain, min(LONGEST, left - MARGIN))
    if outcome is None:
        logger.info("no certificate was ever ordered here: nothing to renew")
        return {"certificate": "none"}
    said = {
        "certificate": "ordered" if outcome.ordered else outcome.decision.verdict.value,
        "notAfter": outcome.stored.not_after.isoformat() if outcome.stored else "",
    }
    logger.info("certificate: " + outcome.decision.why, extra=said)
    return said
