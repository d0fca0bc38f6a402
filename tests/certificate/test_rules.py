"""The decisions when a certificate is ordered, without an authority."""

from datetime import UTC, datetime, timedelta

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.certificates import rules
from hippodrome.control.certificates.rules import (
    CLAIM,
    STAGING,
    CertificateRecord,
    Decision,
    FailedOrder,
    FailureReason,
    StoredCertificate,
    Verdict,
)
from hippodrome.control.model.records import from_json, to_json

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
NAMES = ("*.example.org",)
DAY = timedelta(days=1)


def stored(age=DAY, lifetime=90 * DAY, **more):
    return StoredCertificate(
        **{
            "names": NAMES,
            "serial": "1",
            "not_before": NOW - age,
            "not_after": NOW - age + lifetime,
            "directory": STAGING,
            **more,
        }
    )


def failure(ago, trouble=FailureReason.VALIDATION, directory=STAGING, until=None):
    return FailedOrder(NOW - ago, directory, trouble, until=until)


NEVER = CertificateRecord()


def decide(state=NEVER, present=None, force=False, directory=STAGING) -> Decision:
    return rules.decide(state, present, directory, NAMES, now=NOW, force=force)


@pytest.mark.parametrize(
    ("lifetime", "left"),
    [(398, 30), (90, 30), (64, 64 / 3), (47, 47 / 3), (45, 15), (10, 10 / 3), (160 / 24, 80 / 24), (1, 0.5)],
)
def test_a_certificate_is_renewed_so_many_days_before_its_end(lifetime, left):
    end = NOW + lifetime * DAY
    assert abs(end - rules.renew_at(NOW, end) - left * DAY) < timedelta(seconds=1)


@given(st.timedeltas(min_value=timedelta(minutes=1), max_value=timedelta(days=4000)))
def test_a_certificate_is_renewed_after_its_first_half_and_before_its_end(lifetime):
    at = rules.renew_at(NOW, NOW + lifetime)
    assert NOW + lifetime / 2 - timedelta(milliseconds=1) <= at < NOW + lifetime  # times have whole microseconds
    assert at >= NOW + lifetime - timedelta(days=30) - timedelta(seconds=1)


@pytest.mark.parametrize(
    ("present", "due"),
    [
        (None, Verdict.ORDER),
        (stored(), Verdict.FRESH),
        (stored(59 * DAY), Verdict.FRESH),
        (stored(60 * DAY), Verdict.ORDER),
        (stored(91 * DAY), Verdict.ORDER),
        (stored(names=("*.example.com",)), Verdict.ORDER),
        (stored(names=()), Verdict.ORDER),
        (stored(directory=rules.PRODUCTION), Verdict.ORDER),
        (stored(directory=""), Verdict.FOREIGN),
        (stored(91 * DAY, directory=""), Verdict.FOREIGN),
    ],
)
def test_the_decision_follows_from_the_present_certificate(present, due):
    assert decide(present=present).verdict is due
    assert decide(present=present).why
    assert decide(present=present, force=True).verdict is Verdict.ORDER


def test_the_wait_after_failures_grows_with_their_number():
    for count, minutes in [(1, 1), (2, 10), (3, 100), (4, 1200), (9, 1200)]:
        failures = [failure(timedelta(seconds=30), FailureReason.TIMEOUT)] * count
        decision = decide(CertificateRecord(failures=tuple(failures)))
        assert (decision.verdict, decision.until) == (
            Verdict.WAIT,
            NOW - timedelta(seconds=30) + timedelta(minutes=minutes),
        )
        assert decide(CertificateRecord(failures=tuple(failures)), force=True).verdict is Verdict.ORDER


def test_a_daily_timer_tries_every_day():
    failures = tuple(failure(n * DAY) for n in (3, 2, 1))
    assert decide(CertificateRecord(failures=failures)).verdict is Verdict.ORDER
    assert (
        decide(CertificateRecord(failures=(*failures, failure(DAY - timedelta(minutes=10))))).verdict is Verdict.ORDER
    )


def test_even_with_force_at_most_four_validations_an_hour_may_fail():
    recent = tuple(failure(timedelta(minutes=m)) for m in (50, 40, 30, 20))
    decision = decide(CertificateRecord(failures=recent), force=True)
    assert (decision.verdict, decision.until) == (Verdict.WAIT, NOW + timedelta(minutes=10))
    assert decide(CertificateRecord(failures=recent[1:]), force=True).verdict is Verdict.ORDER
    assert decide(CertificateRecord(failures=recent), force=True, directory=rules.PRODUCTION).verdict is Verdict.ORDER
    others = tuple(failure(timedelta(minutes=m), FailureReason.TIMEOUT) for m in (5, 4, 3, 2, 1))
    assert decide(CertificateRecord(failures=others), force=True).verdict is Verdict.ORDER


def test_a_wait_that_the_authority_asked_for_holds_even_with_force():
    asked = CertificateRecord(failures=(failure(DAY, FailureReason.RATE_LIMITED, until=NOW + DAY),))
    for force in (False, True):
        assert decide(asked, force=force) == Decision(Verdict.WAIT, decide(asked).why, NOW + DAY)
    over = CertificateRecord(failures=(failure(DAY, FailureReason.RATE_LIMITED, until=NOW),))
    assert decide(over).verdict is Verdict.ORDER


def test_a_failure_in_the_future_does_not_prevent_orders():
    assert decide(CertificateRecord(failures=(failure(-400 * DAY),))).verdict is Verdict.ORDER


def test_a_claim_prevents_other_orders_for_a_limited_time():
    held = rules.claimed(CertificateRecord(), "me", NOW - CLAIM + timedelta(seconds=1))
    assert decide(held) == Decision(Verdict.BUSY, decide(held).why, NOW + timedelta(seconds=1))
    assert decide(held, force=True).verdict is Verdict.ORDER
    assert decide(rules.claimed(CertificateRecord(), "me", NOW - CLAIM)).verdict is Verdict.ORDER
    assert decide(held, stored()).verdict is Verdict.FRESH


@given(st.integers(0, 30), st.text(max_size=3000))
def test_the_size_of_the_state_is_limited(count, text):
    state = CertificateRecord()
    for _ in range(count):
        state = rules.failed(state, FailedOrder(NOW, STAGING, FailureReason.REFUSED, text))
    assert len(state.failures) <= rules.MAX_FAILURES
    assert all(len(one.text) <= rules.MAX_TEXT for one in state.failures)
    assert from_json(to_json(state), CertificateRecord) == state
    assert rules.succeeded(stored(), "", NOW).failures == ()


def test_a_state_with_times_without_a_zone_is_refused():
    with pytest.raises(msgspec.ValidationError):
        from_json(b'{"claimed": "2026-01-01T00:00:00"}', CertificateRecord)


def test_the_days_left_may_be_negative():
    assert stored().days_left(NOW) == 89
    assert stored(DAY, 2 * DAY).days_left(NOW) == 1
    assert stored(2 * DAY, DAY).days_left(NOW) == -1
