"""Daily timer: renews the servers' certificate, when it is due, from the ACME directory that issued it."""

from __future__ import annotations

from typing import Any, cast

from hippodrome.control.aws import AwsPlatform
from hippodrome.control.certificates.renewal import Renewal, renew
from hippodrome.control.certificates.rules import location
from hippodrome.control.log import failure, logger
from hippodrome.functions import installed

MAX_ORDER_SECONDS = 480.0  # an order usually takes one to two minutes
MARGIN = 60.0  # seconds kept for the end of an order: its last request, removing the TXT record, writing the state


def handler(event: dict[str, Any], context: Any) -> dict[str, str]:
    """Renew the certificate if it is due; return the decision and the certificate's expiry (`notAfter`, ISO 8601).

    Raises if an order fails; an alarm reports failed invocations.
    """
    platform = cast(AwsPlatform, installed.platform())  # this function runs on AWS only
    domain = platform.settings.servers_domain
    left = context.get_remaining_time_in_millis() / 1000 if context else MAX_ORDER_SECONDS + MARGIN
    renewal = Renewal(
        platform.documents,
        platform.challenges,
        platform.now,
        location(domain),
        tell=lambda stage: logger.info("certificate", extra={"stage": stage.value}),
        note=failure,
    )
    outcome = renew(renewal, domain, min(MAX_ORDER_SECONDS, left - MARGIN))
    if outcome is None:
        logger.info("there is no certificate that Hippodrome has ordered: nothing to renew")
        return {"certificate": "none"}
    result = {
        "certificate": "ordered" if outcome.ordered else outcome.decision.verdict.value,
        "notAfter": outcome.stored.not_after.isoformat() if outcome.stored else "",
    }
    logger.info("certificate: " + outcome.decision.why, extra=result)
    return result
