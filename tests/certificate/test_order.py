"""Certificates ordered at a real ACME authority (Pebble): first, renewed, refused, interrupted, two at once."""

from __future__ import annotations

import base64
import http.server
import json
import logging
import os
import signal
import socket
import ssl
import subprocess
import sys
import threading
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization

from hippodrome.control.certificates.renewal import Renewal, renew
from hippodrome.control.certificates.rules import (
    ACCOUNT,
    CLAIM,
    FailureReason,
    OrderFailed,
    OrderStage,
    RenewalRequest,
    Verdict,
    chain_of,
    renew_at,
)
from hippodrome.control.ports import Conflict
from hippodrome.local.backend.documents import FolderDocuments
from hippodrome.trial.recordings.store import FolderStore
from hippodrome.trial.server.listener import Certificate
from hippodrome.trial.settings import TrialSettings
from tests.certificate.conftest import DOMAIN, FULLCHAIN, PLACE, PRIVKEY, ROOT_DOMAIN, STATE, Place
from tests.certificate.pebble import make_ca

ROOT = Path(__file__).resolve().parents[2]


def handshake(server: ssl.SSLContext, root: str, host: str) -> x509.Certificate:
    """Make a TLS handshake in memory, with a browser's checks; the server's certificate."""
    client = ssl.create_default_context(cadata=root)
    to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
    there = client.wrap_bio(to_client, to_server, server_hostname=host)
    here = server.wrap_bio(to_server, to_client, server_side=True)
    for _ in range(10):
        done = 0
        for side in (there, here):
            try:
                side.do_handshake()
                done += 1
            except ssl.SSLWantReadError:
                pass
        if done == 2:
            return x509.load_der_x509_certificate(there.getpeercert(True))
    raise AssertionError("no handshake")


def served(place: Place) -> Certificate:
    """Return the TLS context that a trial server makes of the bucket."""
    env = {
        "PROJECT_ID": "a",
        "USER_ID": "b",
        "SERVER": "c",
        "TOKEN": "d",
        "GAME_STEPS": "1",
        "STORE": "e",
        "TRIAL": "{}",
    }
    settings = TrialSettings.from_env({**env, "SSL_FULLCHAIN": FULLCHAIN, "SSL_PRIVKEY": PRIVKEY, "TLS": "on"})
    certificate = Certificate(settings, FolderStore(place.folder))
    certificate.load()
    return certificate


def test_the_first_order_stores_certificate_state_and_account(place):
    outcome = place.obtain(email="admin@example.org")
    assert outcome.ordered
    assert outcome.stored.names == (f"*.{DOMAIN}",)
    assert place.stages == list(OrderStage)
    assert place.challenges.puts[0][0] == f"_acme-challenge.{DOMAIN}"
    assert not place.challenges.present
    assert chain_of(place.key.encode()).decode() == place.chain
    assert place.chain.count("BEGIN CERTIFICATE") == 2
    state = place.state
    assert state.directory == place.pebble.directory
    assert state.serial == outcome.stored.serial
    assert (state.claim, state.failures) == ("", ())
    assert "admin@" not in place.read(STATE) + place.read(ACCOUNT)
    key = serialization.load_pem_private_key(place.key.encode(), None)
    assert key.curve.name == "secp256r1"
    assert place.notes == []


def test_browsers_that_trust_the_authority_accept_it_for_the_servers_names_only(place):
    place.obtain()
    server, root = served(place), place.pebble.root()
    shown = handshake(server.context, root, f"k3f9-1.{DOMAIN}")
    assert f"{shown.serial_number:x}" == place.state.serial
    site = f"study.{ROOT_DOMAIN}"
    for host in (site, ROOT_DOMAIN, f"k3f9-1.{ROOT_DOMAIN}", DOMAIN, f"a.b.{DOMAIN}", "example.com"):
        with pytest.raises(ssl.SSLCertVerificationError):
            handshake(server.context, root, host)
    with pytest.raises(ssl.SSLCertVerificationError):
        handshake(server.context, place.pebble.trusted, f"k3f9-1.{DOMAIN}")


def test_a_fresh_certificate_is_not_ordered_again(place):
    place.obtain()
    before, orders = place.key, place.pebble.orders()
    place.ahead = timedelta(days=59)
    assert place.obtain().decision.verdict is Verdict.FRESH
    assert renew(place.renewal(), DOMAIN, 60).decision.verdict is Verdict.FRESH
    assert place.pebble.orders() == orders
    assert place.key == before


def test_a_renewal_has_a_new_key_and_the_same_account(place):
    place.obtain()
    first, account, accounts = place.key, place.read(ACCOUNT), place.pebble.accounts()
    place.ahead = timedelta(days=61)
    outcome = renew(place.renewal(), DOMAIN, 60)
    assert outcome.ordered
    assert place.read(ACCOUNT) == account
    assert place.pebble.accounts() == accounts
    keys = [serialization.load_pem_private_key(text.encode(), None).public_key() for text in (first, place.key)]
    assert keys[0] != keys[1]
    assert served(place)


def test_without_an_earlier_order_the_timer_orders_nothing(place):
    orders = place.pebble.orders()
    assert renew(place.renewal(), DOMAIN, 60) is None
    assert place.pebble.orders() == orders
    assert not (place.folder / STATE).exists()


def test_an_expired_certificate_is_replaced(place):
    place.obtain()
    place.ahead = timedelta(days=200)
    outcome = place.obtain()
    assert outcome.ordered
    assert "expired" in outcome.decision.why


def test_a_short_lived_certificate_is_renewed_at_half_its_lifetime(tmp_path, second_pebble):
    place = Place(tmp_path, second_pebble)
    stored = place.obtain().stored
    at = renew_at(stored.not_before, stored.not_after)
    assert timedelta(hours=79) < at - stored.not_before < timedelta(hours=81)
    place.ahead = timedelta(hours=78)
    assert not place.obtain().ordered
    place.ahead = timedelta(hours=81)
    assert place.obtain().ordered


def test_the_authority_can_be_changed_and_changed_back(place, second_pebble):
    here, there = place.pebble, second_pebble
    place.obtain()
    account = json.loads(place.read(ACCOUNT))[here.directory]
    there_challenges, place.challenges._pebble = place.challenges, there
    assert place.obtain(pebble=there).ordered
    assert place.state.directory == there.directory
    assert place.renewal().last_directory() == there.directory
    handshake(served(place).context, there.root(), f"a.{DOMAIN}")
    assert not place.obtain(pebble=there).ordered
    there_challenges._pebble = here
    assert place.obtain(pebble=here).ordered
    assert json.loads(place.read(ACCOUNT))[here.directory] == account
    assert set(json.loads(place.read(ACCOUNT))) == {here.directory, there.directory}
    handshake(served(place).context, here.root(), f"a.{DOMAIN}")


def test_wrong_values_in_dns_fail_the_order_and_keep_the_certificate(place):
    place.obtain()
    place.lose_account()
    kept = place.key, place.chain
    place.challenges.lies = True
    place.ahead = timedelta(days=61)
    with pytest.raises(OrderFailed) as failed:
        place.obtain()
    assert failed.value.reason is FailureReason.VALIDATION
    assert str(failed.value)
    assert not place.challenges.present
    assert (place.key, place.chain) == kept
    state = place.state
    assert [failure.reason for failure in state.failures] == ["validation"]
    assert state.claim == ""
    # Then it waits; with `force` it may try three times more within the hour.
    orders = place.pebble.orders()
    waiting = place.obtain()
    assert waiting.decision.verdict is Verdict.WAIT
    assert place.pebble.orders() == orders
    for _ in range(3):
        with pytest.raises(OrderFailed):
            place.obtain(force=True)
    orders = place.pebble.orders()
    refused = place.obtain(force=True)
    assert refused.decision.verdict is Verdict.WAIT
    assert timedelta(minutes=55) < refused.decision.until - place.now() <= timedelta(hours=1)
    assert place.pebble.orders() == orders
    # When DNS is right and time has passed, the failures do not matter any more.
    place.challenges.lies = False
    place.ahead += timedelta(hours=21)
    assert place.obtain().ordered
    assert place.state.failures == ()


@pytest.mark.parametrize("stage", OrderStage)
@pytest.mark.parametrize("what", [KeyboardInterrupt, RuntimeError, OSError])
def test_after_an_interruption_at_any_stage_the_next_run_goes_on(place, stage, what):
    def tell(reached):
        if reached is stage:
            raise what("here")

    with pytest.raises(what):
        place.renewal(tell=tell).obtain(place.wish())
    assert not place.challenges.present
    state = place.state
    assert state.claim == ""
    assert len(state.failures) == (0 if what is KeyboardInterrupt else 1)
    if state.failures:
        assert "here" not in place.read(STATE)
        place.ahead = timedelta(minutes=2)
    assert place.obtain().ordered
    assert not place.challenges.present
    assert served(place)


class Killed(BaseException):
    pass


class Mortal:
    """Documents of a process that is killed at its n-th write: no later call works, and nothing is cleaned up."""

    def __init__(self, documents, writes):
        self._documents = documents
        self.left = writes

    def __getattr__(self, name):
        def call(*args):
            if name in {"create", "replace"} and self.left >= 0:
                self.left -= 1
            if self.left < 0:
                raise Killed
            return getattr(self._documents, name)(*args)

        return call


def killed_at(place, writes):
    """Order a certificate in a process that is killed after so many writes. Return False if it ended before."""
    try:
        place.renewal(Mortal(place.documents, writes)).obtain(place.wish())
    except Killed:
        return True
    return False


def test_after_a_kill_at_any_write_the_next_run_goes_on(place):
    """The run replaces a certificate that is in use: at any moment a server that starts finds a pair that fits."""
    place.obtain()
    for writes in range(20):
        serial = place.state.serial
        place.ahead += timedelta(days=61)
        challenges = place.challenges
        if not killed_at(place, writes):
            break
        assert served(place)
        stored = place.renewal().read()[1]
        if stored.serial == serial:  # not yet stored: the killed run's claim has to lapse
            if place.state.claim:
                assert place.obtain().decision.verdict is Verdict.BUSY
                place.ahead += CLAIM
        else:
            assert place.obtain(pebble=None).decision.verdict in {Verdict.FRESH, Verdict.ORDER, Verdict.BUSY}
            place.ahead += CLAIM
        place.obtain()
        assert served(place)
        assert place.state.claim == ""
        assert not challenges.present
        assert chain_of(place.key.encode()).decode() == place.chain
        assert place.state.serial == place.renewal().read()[1].serial
    else:
        pytest.fail("it never came to an end")
    assert writes >= 4  # one less if the authority remembers that the name was proved


def test_after_a_kill_at_any_write_of_the_first_order_servers_have_a_whole_pair(place):
    """As soon as there is a key, a server can start."""
    for writes in range(20):
        if not killed_at(place, writes):
            break
        if (place.folder / PRIVKEY).exists():
            assert served(place)
        place.ahead += CLAIM
        place.obtain()
        assert chain_of(place.key.encode()).decode() == place.chain
        assert place.state.serial == place.renewal().read()[1].serial
        for path in filter(Path.is_file, place.folder.rglob("*.*")):
            path.unlink()
    assert 4 < writes < 19


def test_a_process_killed_while_it_waits_leaves_a_claim_that_lapses(place, tmp_path):
    """A real process gets SIGKILL: the next run replaces its record in DNS, and removes it."""
    program = """
import os, signal, sys
from datetime import UTC, datetime
from pathlib import Path
from hippodrome.control.certificates.rules import RenewalRequest, location
from hippodrome.control.certificates.renewal import Renewal
from hippodrome.local.backend.documents import FolderDocuments
class Nowhere:
    def put(self, *_): os.kill(os.getpid(), signal.SIGKILL)
    def remove(self, *_): pass
folder, directory, trusted = sys.argv[1:]
Renewal(FolderDocuments(Path(folder, "bucket"), Path(folder, "state")), Nowhere(), lambda: datetime.now(UTC),
    location("servers.example.org")).obtain(RenewalRequest("servers.example.org", directory, trusted=trusted))
"""
    command = [sys.executable, "-c", program, str(tmp_path), place.pebble.directory, place.pebble.trusted]
    ended = subprocess.run(command, check=False, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}, timeout=60)
    assert ended.returncode == -signal.SIGKILL
    assert place.state.claim
    busy = place.obtain()
    assert busy.decision.verdict is Verdict.BUSY
    assert busy.decision.until - place.now() <= CLAIM
    place.ahead = CLAIM
    assert place.obtain().ordered
    assert place.challenges.puts[0][0] == f"_acme-challenge.{DOMAIN}"
    assert not place.challenges.present


class Paused:
    """Documents of a run that has read everything, and waits before its first write of the state."""

    def __init__(self, documents, wait):
        self._documents = documents
        self._wait = [wait]

    def __getattr__(self, name):
        return getattr(self._documents, name)

    def replace(self, key, body, etag):
        if key == STATE and self._wait:
            self._wait.pop()()
        return self._documents.replace(key, body, etag)


class PausedChallenges:
    """Challenges of a run that waits, in the middle of its order, until the others have ended."""

    def __init__(self, challenges, wait):
        self._challenges = challenges
        self._wait = wait

    def __getattr__(self, name):
        return getattr(self._challenges, name)

    def put(self, *args):
        self._wait()
        self._challenges.put(*args)


def test_of_several_renewals_at_once_one_orders_and_servers_read_a_whole_pair(place):
    """All have read the old certificate before any of them claims the order; the others end while that one orders."""
    place.obtain()
    place.ahead = timedelta(days=61)
    orders, outcomes, wrong = place.pebble.orders(), [], []
    looked, ended, stop = threading.Barrier(3), threading.Semaphore(0), threading.Event()

    def others_have_ended():
        assert ended.acquire(timeout=60)
        assert ended.acquire(timeout=60)

    def run():
        documents = Paused(
            FolderDocuments(place.folder, place.folder.parent / "state"), lambda: looked.wait(timeout=60)
        )
        renewal = Renewal(documents, PausedChallenges(place.challenges, others_have_ended), place.now, PLACE)
        try:
            outcomes.append(renewal.obtain(place.wish()))
        finally:
            ended.release()

    def read():
        certificate = served(place)
        while not stop.is_set():
            try:
                certificate.load()
            except Exception as error:  # noqa: BLE001
                wrong.append(error)

    threads = [threading.Thread(target=run) for _ in range(3)]
    reader = threading.Thread(target=read)
    for thread in [*threads, reader]:
        thread.start()
    for thread in threads:
        thread.join()
    stop.set()
    reader.join()
    assert sorted(outcome.decision.verdict for outcome in outcomes) == sorted(
        [Verdict.BUSY, Verdict.BUSY, Verdict.ORDER]
    )
    assert place.pebble.orders() == orders + 1
    assert wrong == []
    assert not place.challenges.present


def test_a_renewal_that_read_the_state_before_another_ordered_does_not_order_again(place):
    """It has read the old certificate, and writes its claim when the other run is done. Then it reads again, and finds the new certificate."""
    place.obtain()
    place.ahead = timedelta(days=61)
    orders = place.pebble.orders()

    def another_orders():
        assert place.obtain().ordered
        # Pebble has issued it now and not in 61 days: by the clock of the test it would be due for renewal at once.
        place.ahead = timedelta()

    late = Renewal(Paused(place.documents, another_orders), place.challenges, place.now, PLACE).obtain(place.wish())
    assert late.decision.verdict is Verdict.FRESH
    assert place.pebble.orders() == orders + 1


def test_a_run_that_was_overtaken_stores_nothing(place):
    """A run with --force takes over from a slow run; the slow run notices it and stores nothing."""
    other = []

    def tell(stage):
        if stage is OrderStage.ISSUE and not other:
            other.append(place.obtain(force=True))

    with pytest.raises(OrderFailed) as failed:
        place.renewal(tell=tell).obtain(place.wish())
    assert failed.value.reason is FailureReason.OVERTAKEN
    assert place.renewal().read()[1].serial == other[0].stored.serial == place.state.serial
    assert place.state.failures == ()
    assert served(place)
    assert not place.challenges.present


def test_a_lost_or_damaged_state_is_made_anew(place):
    serial = place.obtain().stored.serial
    for content in (None, b"{", b'{"claimed": "2026-01-01T00:00:00"}', b'["a"]'):
        (place.folder / STATE).unlink()
        if content is not None:
            place.documents.create(STATE, content)
        outcome = renew(place.renewal(), DOMAIN, 60)
        assert outcome.decision.verdict is Verdict.FRESH
        assert place.state.serial == serial


def test_a_damaged_certificate_is_replaced(place):
    place.obtain()
    (place.folder / PRIVKEY).write_text(place.key[:300])
    assert place.obtain().ordered
    assert served(place)


def test_a_certificate_that_was_put_there_by_hand_is_not_changed(place, tmp_path):
    _, chain, key = make_ca(tmp_path)
    place.documents.create(FULLCHAIN, chain.read_bytes())
    place.documents.create(PRIVKEY, key.read_bytes())
    before = place.key
    assert renew(place.renewal(), DOMAIN, 60) is None
    assert place.obtain().decision.verdict is Verdict.FOREIGN
    assert place.key == before
    assert place.obtain(force=True).ordered
    assert place.renewal().last_directory() == place.pebble.directory
    assert served(place)


def test_a_challenge_record_that_cannot_be_removed_does_not_fail_the_order(place):
    """The certificate is stored nevertheless; the next order replaces the record, and removes it."""
    remove, place.challenges.remove = place.challenges.remove, None
    assert place.obtain().ordered
    assert place.notes == ["the challenge's TXT record could not be removed"]
    place.challenges.remove = remove
    place.obtain(force=True)
    assert not place.challenges.present


def test_no_private_key_is_ever_logged(place, caplog, capfd):
    caplog.set_level(logging.DEBUG)
    place.obtain()
    said = caplog.text + "".join(capfd.readouterr())
    assert "order-plz" in said  # the library does log something
    value = serialization.load_pem_private_key(place.key.encode(), None).private_numbers().private_value
    plain = base64.urlsafe_b64encode(value.to_bytes(32, "big")).decode().rstrip("=")
    secrets = place.key.split("-----BEGIN CERT")[0].splitlines()[2:4]  # the third line is the public part
    secrets += [f"{value:x}", f"{value}", plain, *(key["d"] for key in json.loads(place.read(ACCOUNT)).values())]
    assert all(len(secret) > 40 for secret in secrets)
    for secret in secrets:
        assert secret not in said
        assert secret not in place.read(STATE)


def test_a_name_that_the_authority_refuses_fails_the_order(place):
    with pytest.raises(OrderFailed) as failed:
        place.obtain(domain="blocked.example")
    assert failed.value.reason is FailureReason.REFUSED
    assert "blocked" in str(failed.value) or "polic" in str(failed.value).lower()


def test_an_authority_that_is_not_trusted_counts_as_unreachable(place):
    with pytest.raises(OrderFailed) as failed:
        place.obtain(trusted="")
    assert failed.value.reason is FailureReason.UNREACHABLE
    assert "trusted" in str(failed.value)


class Conflicting:
    """Documents whose every write succeeds and raises Conflict, as S3 answers a write that was sent twice."""

    def __init__(self, documents):
        self._documents = documents

    def get(self, *args):
        return self._documents.get(*args)

    def create(self, *args):
        self._documents.create(*args)
        raise Conflict(args[0])

    def replace(self, *args):
        self._documents.replace(*args)
        raise Conflict(args[0])


def test_writes_whose_answers_are_lost_do_not_fail_the_order(place):
    assert place.renewal(Conflicting(place.documents)).obtain(place.wish()).ordered
    assert place.state.claim == ""
    assert served(place)


# ---- authorities that do not behave as Pebble does


@contextmanager
def authority(answers):
    """An HTTP server that answers by path: (status, headers, body)."""

    class Handler(http.server.BaseHTTPRequestHandler):
        def _answer(self):
            self.rfile.read(int(self.headers.get("Content-Length") or 0))
            status, headers, body = answers(self.path, f"http://127.0.0.1:{self.server.server_port}")
            self.send_response(status)
            self.send_header("Replay-Nonce", "bm9uY2U")
            for name, value in headers.items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        do_GET = do_POST = do_HEAD = _answer

        def log_message(self, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/dir"
    finally:
        server.shutdown()
        server.server_close()


def acme(order):
    def answers(path, here):
        if path == "/dir":
            places = {name: f"{here}/{name}" for name in ("newNonce", "newAccount", "newOrder")}
            return 200, {"Content-Type": "application/json"}, json.dumps(places).encode()
        if path == "/newAccount":
            return 201, {"Content-Type": "application/json", "Location": f"{here}/account/1"}, b'{"status": "valid"}'
        return order if path == "/newOrder" else (200, {}, b"")

    return answers


def problem(kind, detail, status=429, **headers):
    body = {"type": f"urn:ietf:params:acme:error:{kind}", "detail": detail, "status": status}
    return status, {"Content-Type": "application/problem+json", **headers}, json.dumps(body).encode()


class Deaf:
    def put(self, name, values, seconds):
        raise AssertionError("nothing is to be published")

    def remove(self, name, values):
        raise AssertionError("nothing was published")


def alone(tmp_path):
    documents = FolderDocuments(tmp_path / "bucket", tmp_path / "state")
    return Renewal(documents, Deaf(), lambda: datetime.now(UTC), PLACE)


def refused(retry_after):
    headers = {} if retry_after is None else {"Retry-After": retry_after}
    return problem("rateLimited", "too many", **headers)


@pytest.mark.parametrize(
    ("answer", "hours"),
    [
        (lambda now: refused("7200"), 2),
        (lambda now: refused(f"{now + timedelta(hours=3):%a, %d %b %Y %H:%M:%S} GMT"), 3),
        (lambda now: refused(None), 1),
        (lambda now: refused("9" * 40), 8 * 24),
        (lambda now: refused("soon"), 1),
    ],
    ids=["seconds", "date", "nothing", "absurd", "nonsense"],
)
def test_the_wait_of_a_rate_limit_is_observed(tmp_path, answer, hours):
    """The time that the authority asks to wait is observed, even with `force`."""
    with authority(acme(answer(datetime.now(UTC)))) as directory:
        renewal, wish = alone(tmp_path), RenewalRequest(DOMAIN, directory)
        with pytest.raises(OrderFailed) as failed:
            renewal.obtain(wish)
        assert failed.value.reason is FailureReason.RATE_LIMITED
        assert abs(failed.value.until - datetime.now(UTC) - timedelta(hours=hours)) < timedelta(minutes=5)
        decision = renewal.obtain(RenewalRequest(DOMAIN, directory, force=True)).decision
        assert (decision.verdict, decision.until) == (Verdict.WAIT, failed.value.until)
        # The limit does not hold for another authority.
        assert renewal.decide(RenewalRequest(DOMAIN, "https://elsewhere.example/dir")).verdict is Verdict.ORDER


@pytest.mark.parametrize(
    ("answers", "trouble"),
    [
        (acme(problem("caa", "CAA record for example.org prevents issuance", 403)), FailureReason.CAA),
        (acme(problem("serverInternal", "sorry", 500)), FailureReason.UNREACHABLE),
        (acme(problem("badNonce", "again", 400)), FailureReason.UNREACHABLE),
        (acme(problem("unauthorized", "account deactivated", 403)), FailureReason.REFUSED),
        (acme(problem("never heard of", "\x1b[31mred\x1b[0m\nnew line", 403)), FailureReason.REFUSED),
        (acme((503, {}, b"<html>maintenance</html>")), FailureReason.UNREACHABLE),
        (
            acme((201, {"Content-Type": "application/json"}, b'{"status": "pending", "identifiers": 3}')),
            FailureReason.BROKEN,
        ),
        (lambda path, here: (200, {"Content-Type": "application/json"}, b"{}"), FailureReason.BROKEN),
        (lambda path, here: (200, {"Content-Type": "text/html"}, b"<html>"), FailureReason.BROKEN),
        (lambda path, here: (200, {"Content-Type": "application/json"}, b"[1]"), FailureReason.BROKEN),
    ],
)
def test_refusals_and_malformed_answers_of_an_authority_have_their_reasons(tmp_path, answers, trouble):
    with authority(answers) as directory:
        renewal = alone(tmp_path)
        with pytest.raises(OrderFailed) as failed:
            renewal.obtain(RenewalRequest(DOMAIN, directory))
    assert failed.value.reason is trouble
    assert str(failed.value).isprintable()
    state, stored = renewal.read()
    assert [failure.reason for failure in state.failures] == [trouble]
    assert stored is None
    assert state.claim == ""


@pytest.mark.parametrize(("times", "trouble"), [(7, FailureReason.CAA), (8, FailureReason.UNREACHABLE)])
def test_a_nonce_may_be_refused_a_limited_number_of_times(tmp_path, times, trouble):
    refusals = [problem("badNonce", "again", 400)] * times

    def answers(path, here):
        refused = path == "/newOrder" and refusals
        return refusals.pop() if refused else acme(problem("caa", "it was heard", 403))(path, here)

    with authority(answers) as directory, pytest.raises(OrderFailed) as failed:
        alone(tmp_path).obtain(RenewalRequest(DOMAIN, directory))
    assert failed.value.reason is trouble


def test_an_authority_that_does_not_answer_is_unreachable(tmp_path):
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))  # it holds the port without listening, so no server of another test gets the port
        with pytest.raises(OrderFailed) as failed:
            alone(tmp_path).obtain(RenewalRequest(DOMAIN, f"http://127.0.0.1:{silent.getsockname()[1]}/dir"))
    assert failed.value.reason is FailureReason.UNREACHABLE
