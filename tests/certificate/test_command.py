"""The command `hippodrome certificate`: S3 and Route 53 on moto, a real authority, and the test's own DNS server."""

import json
import secrets
import socket
from datetime import UTC, datetime, timedelta

import pytest
from cryptography import x509
from moto.route53.models import HostedZoneIdentifier

from hippodrome.control.aws.challenges import Route53Challenges
from hippodrome.control.certificates import rules
from hippodrome.control.certificates.renewal import Renewal
from hippodrome.control.certificates.rules import PRODUCTION, STAGING, CertificateRecord, FailedOrder, FailureReason
from hippodrome.control.model.records import from_json, to_json
from hippodrome.deployment.stack import certificate
from tests.certificate.conftest import FULLCHAIN, PRIVKEY, STATE
from tests.certificate.nameserver import answering, ask_only
from tests.certificate.pebble import answer_as_route_53, make_ca
from tests.deployment.installation import Installed

DOMAIN = "example.org"


@pytest.fixture(autouse=True)
def zone_ids(monkeypatch):
    """Gap: ids of moto's hosted zones begin with any letter. AWS's begin with Z."""
    monkeypatch.setattr(HostedZoneIdentifier, "generate", lambda *_, **__: f"Z{secrets.token_hex(10).upper()}")


@pytest.fixture
def world(zone_ids):
    with Installed() as installed:
        yield installed


@pytest.fixture
def zone(world):
    """The name servers that Route 53 gave the zone."""
    return world.client("route53").get_hosted_zone(Id=world.ids["zone"])["DelegationSet"]["NameServers"]


@pytest.fixture
def internet(monkeypatch):
    """No DNS server answers until the test calls this fixture with records."""
    stack = []

    def say(records):
        context = answering(records)
        stack.append(context)
        ask_only(monkeypatch, context.__enter__())
        # This server answers each question, but on a busy machine it may need more than the 0.2 s of the deaf one below.
        monkeypatch.setattr("hippodrome.deployment.aws.hosted_zone.DNS_TIMEOUT", 60.0)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        ask_only(monkeypatch, deaf.getsockname()[1])
        monkeypatch.setattr("hippodrome.deployment.aws.hosted_zone.DNS_TIMEOUT", 0.2)
        yield say
    for context in stack:
        context.__exit__(None, None, None)


@pytest.fixture
def delegated(internet, zone):
    def say(**caa):
        records = {(DOMAIN, "NS"): [f"{server}." for server in zone]}
        internet({**records, **{(name.replace("_", "."), "CAA"): values for name, values in caa.items()}})

    say()
    return say


@pytest.fixture
def own(pebble, world, tmp_path, monkeypatch):
    """The options for Pebble as the authority; Pebble's DNS gets the records that Route 53 gets."""
    answer_as_route_53(pebble, monkeypatch)
    roots = tmp_path / "roots.pem"
    roots.write_text(pebble.trusted)
    return ["--directory", pebble.directory, "--ca-file", str(roots)]


def txt(world):
    found = world.client("route53").list_resource_record_sets(HostedZoneId=world.ids["zone"])["ResourceRecordSets"]
    return [record for record in found if record["Type"] == "TXT"]


def state(world):
    return from_json(world.get(STATE), CertificateRecord)


def by_hand(world, folder, origin=""):
    """Store a certificate of a CA of its own, valid for a day; `origin` makes it look like one that Hippodrome has ordered."""
    _, chain, key = make_ca(folder)
    world.put(FULLCHAIN, chain.read_bytes())
    text = (
        f"Hippodrome: ordered at {origin}\n".encode() + key.read_bytes() + chain.read_bytes()
        if origin
        else key.read_bytes()
    )
    world.put(PRIVKEY, text)


def test_the_command_orders_the_first_certificate(world, own, pebble, capsys):
    looked = world.run(capsys, "certificate", *own, "--dry-run")
    assert looked.code == 3
    assert "There is no certificate yet." in looked.out
    assert "*.servers.example.org" in looked.out
    assert "--production" not in looked.err
    assert world.keys("SSL/") == []
    assert txt(world) == []

    ran = world.run(capsys, "certificate", *own, "--email", "admin@example.org")
    assert ran.code == 0, ran.err
    assert "*.servers.example.org is in place until" in ran.err
    assert "test certificate" not in ran.err
    assert world.keys("SSL/") == sorted(["SSL/account.json", STATE, FULLCHAIN, PRIVKEY])
    assert txt(world) == []
    serial = state(world).serial
    assert f"{x509.load_pem_x509_certificate(world.get(FULLCHAIN)).serial_number:x}" == serial

    again = world.run(capsys, "certificate", "--json")
    assert again.code == 0, again.err
    assert again.json["serial"] == serial
    assert again.json["decision"] == "fresh"
    assert again.json["directory"] == pebble.directory
    assert again.json["daysLeft"] == 89
    assert again.json["trustedByBrowsers"] is False

    said = world.run(capsys, "certificate", "--dry-run")
    assert said.code == 0
    assert "89 days left" in said.out
    assert "Nothing to do" in said.out

    # Without options it comes from the same authority, with the roots that were given the first time.
    forced = world.run(capsys, "certificate", "--force", "--json")
    assert forced.code == 0, forced.err
    assert forced.json["serial"] != serial
    assert state(world).directory == pebble.directory


def test_wrong_values_in_dns_are_reported(world, own, pebble, capsys, monkeypatch):
    put = Route53Challenges.put
    monkeypatch.setattr(
        Route53Challenges, "put", lambda self, name, values, seconds: put(self, name, ["wrong"], seconds)
    )
    ran = world.run(capsys, "certificate", *own)
    assert ran.code == 1
    assert "could not see the proof in DNS" in ran.err
    assert [failure.reason for failure in state(world).failures] == ["validation"]
    assert PRIVKEY not in world.keys("SSL/")
    waiting = world.run(capsys, "certificate", *own)
    assert waiting.code == 1
    assert "the last order failed" in waiting.err
    assert "--force" in waiting.err
    said = world.run(capsys, "certificate", *own, "--dry-run")
    assert said.code == 0
    assert "Nothing would be ordered until" in said.out


def test_after_ctrl_c_the_command_can_be_repeated(world, own, capsys, monkeypatch):
    put = Route53Challenges.put

    def interrupted(self, name, values, seconds):
        put(self, name, values, seconds)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Route53Challenges, "put", interrupted)
        assert world.run(capsys, "certificate", *own).code == 130
    assert txt(world) == []
    assert world.run(capsys, "certificate", *own).code == 0


@pytest.mark.parametrize(
    ("action", "code"), [("s3:PutObject", "AccessDenied"), ("route53:ChangeResourceRecordSets", "AccessDenied")]
)
def test_missing_rights_are_reported(world, own, capsys, action, code):
    world.fail(action, code, "not authorized", status=403)
    ran = world.run(capsys, "certificate", *own)
    assert ran.code == 1
    assert "These credentials may not" in ran.err


def test_a_domain_without_name_servers_is_reported(world, internet, zone, capsys):
    internet({("example.org", "A"): ["192.0.2.1"]})
    ran = world.run(capsys, "certificate", "--production", "--dry-run")
    assert ran.code == 1
    assert "knows no name servers for example.org" in ran.err
    assert "registrar" in ran.err
    for server in zone:
        assert server.rstrip(".") in ran.err


def test_a_domain_with_other_name_servers_is_reported(world, internet, zone, capsys):
    internet({("example.org", "NS"): ["ns1.elsewhere.example.", "ns2.elsewhere.example."]})
    ran = world.run(capsys, "certificate", "--dry-run")
    assert ran.code == 1
    assert "ns1.elsewhere.example" in ran.err
    for server in zone:
        assert server.rstrip(".") in ran.err
    assert world.run(capsys, "certificate").code == 1
    assert world.keys("SSL/") == []


def test_without_an_answer_of_dns_the_command_goes_on(world, internet, capsys):
    ran = world.run(capsys, "certificate", "--dry-run")
    assert ran.code == 3
    assert "could not be asked" in ran.err
    assert "--production" in ran.err


def test_a_delegated_domain_may_be_ordered_for(world, delegated, capsys):
    ran = world.run(capsys, "certificate", "--production", "--dry-run", "--json")
    assert ran.code == 3
    assert ran.json["decision"] == "order"


@pytest.mark.parametrize(
    ("records", "allowed"),
    [
        ({}, True),
        ({"example_org": ['0 issue "letsencrypt.org"']}, True),
        ({"example_org": ['0 issue "amazon.com"', '0 issue "LetsEncrypt.org"']}, True),
        ({"example_org": ['0 issue "letsencrypt.org; validationmethods=dns-01,http-01"']}, True),
        ({"example_org": ['0 issue "letsencrypt.org; validationmethods=http-01"']}, False),
        ({"example_org": ['0 issue "amazon.com"']}, False),
        ({"example_org": ['0 issue ";"']}, False),
        ({"example_org": ['0 issue "letsencrypt.org"', '0 issuewild ";"']}, False),
        ({"example_org": ['0 issue ";"', '0 issuewild "letsencrypt.org"']}, True),
        ({"example_org": ['0 iodef "mailto:admin@example.org"']}, True),
        ({"org": ['0 issue "amazon.com"']}, False),
        ({"org": ['0 issue "amazon.com"'], "example_org": ['0 issue "letsencrypt.org"']}, True),
    ],
)
def test_caa_records_that_forbid_the_authority_are_reported(world, delegated, capsys, records, allowed):
    delegated(**records)
    ran = world.run(capsys, "certificate", "--production", "--dry-run")
    assert ran.code == (3 if allowed else 1), ran.err
    if not allowed:
        assert "CAA record" in ran.err
        assert '0 issuewild "letsencrypt.org"' in ran.err


@pytest.mark.parametrize(
    ("name", "kind", "reported"),
    [
        ("_acme-challenge.servers.example.org", "NS", True),
        ("_acme-challenge.servers.example.org", "CNAME", True),
        ("servers.example.org", "NS", True),
        ("_acme-challenge.servers.example.org", "TXT", False),
        ("_acme-challenge.www.example.org", "CNAME", False),
        ("www.example.org", "NS", False),
    ],
)
def test_a_record_that_hides_the_proof_is_reported_before_an_order(world, delegated, capsys, name, kind, reported):
    value = '"earlier"' if kind == "TXT" else "elsewhere.example.net"
    record = {"Name": name, "Type": kind, "TTL": 60, "ResourceRecords": [{"Value": value}]}
    batch = {"Changes": [{"Action": "CREATE", "ResourceRecordSet": record}]}
    world.client("route53").change_resource_record_sets(HostedZoneId=world.ids["zone"], ChangeBatch=batch)
    ran = world.run(capsys, "certificate", "--production", "--dry-run")
    assert ran.code == (1 if reported else 3), ran.err
    assert (f"has a record {kind} of {name}, so no authority can see the proof" in ran.err) == reported


def test_a_zone_of_another_domain_is_reported(internet, capsys):
    with Installed(RootDomain="example.com") as world:
        ran = world.run(capsys, "certificate", "--dry-run")
    assert ran.code == 1
    assert "example.com does not lie in it" in ran.err


def test_a_missing_zone_is_reported(world, internet, capsys):
    world.client("route53").delete_hosted_zone(Id=world.ids["zone"])
    ran = world.run(capsys, "certificate", "--dry-run")
    assert ran.code == 1
    assert "no hosted zone" in ran.err


def test_a_test_certificate_is_reported_as_one(world, delegated, tmp_path, capsys):
    by_hand(world, tmp_path, origin=STAGING)
    ran = world.run(capsys, "certificate", "--dry-run")
    assert "browsers do not trust it" in ran.err
    assert "hippodrome certificate --production" in ran.err
    assert world.run(capsys, "certificate", "--dry-run", "--json").json["trustedByBrowsers"] is False


def test_a_certificate_that_was_put_there_by_hand_is_not_replaced(world, delegated, tmp_path, capsys):
    by_hand(world, tmp_path)
    before = world.get(PRIVKEY)
    ran = world.run(capsys, "certificate", "--production")
    assert ran.code == 1
    assert "put there by hand, valid until" in ran.err
    assert "--force" in ran.err
    assert world.get(PRIVKEY) == before
    world.put(FULLCHAIN, b"nonsense")
    assert "has expired" in world.run(capsys, "certificate", "--production").err


def test_no_order_is_made_before_the_rate_limit_ends(world, delegated, capsys):
    until = datetime.now(UTC) + timedelta(hours=5)
    failure = FailedOrder(datetime.now(UTC), PRODUCTION, FailureReason.RATE_LIMITED, "too many", until)
    world.put(STATE, to_json(CertificateRecord(failures=(failure,))))
    ran = world.run(capsys, "certificate", "--production", "--force")
    assert ran.code == 1
    assert f"Nothing is ordered until {until.astimezone():%Y-%m-%d %H:%M}" in ran.err


def test_a_rate_limit_that_an_order_meets_is_reported_with_its_end(world, delegated, capsys, monkeypatch):
    until = datetime.now(UTC) + timedelta(hours=5)

    def refused(self, wish):
        raise rules.OrderFailed(FailureReason.RATE_LIMITED, "too many certificates already issued", until)

    monkeypatch.setattr(Renewal, "obtain", refused)
    ran = world.run(capsys, "certificate", "--production")
    assert ran.code == 1
    assert f"Let's Encrypt wants no further orders until {until.astimezone():%Y-%m-%d %H:%M}." in ran.err
    assert "→ Wait; the certificate in place stays." in ran.err


def test_another_run_that_orders_is_reported(world, delegated, capsys):
    world.put(STATE, to_json(rules.claimed(CertificateRecord(), "other", datetime.now(UTC))))
    ran = world.run(capsys, "certificate", "--production")
    assert ran.code == 1
    assert "Another run is ordering" in ran.err


def test_an_authority_that_cannot_be_reached_is_reported(world, own, tmp_path, capsys):
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        directory = f"https://127.0.0.1:{closed.getsockname()[1]}/dir"
        ran = world.run(capsys, "certificate", "--directory", directory, "--ca-file", str(tmp_path / "roots.pem"))
    assert ran.code == 1
    assert "cannot be reached" in ran.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--directory", "http://example.com/dir"], "https://"),
        (["--directory", "https://example.com/dir", "--production"], "Give one of them"),
        (["--directory", "https://example.com/dir", "--staging"], "Give one of them"),
        (["--staging", "--production"], "Give one of them"),
        (["--ca-file", "/nowhere.pem"], "cannot be read"),
        (["--ca-file", __file__.replace("test_command", "nameserver")], "cannot be read"),
    ],
)
def test_wrong_options_are_refused(world, capsys, arguments, said):
    ran = world.run(capsys, "certificate", *arguments)
    assert ran.code == 1
    assert said in ran.err
    assert world.keys("SSL/") == []


def test_every_reason_of_a_failure_has_a_sentence_and_advice():
    from hippodrome.control.certificates.rules import RenewalRequest

    for trouble in FailureReason:
        for directory in (STAGING, PRODUCTION, "https://ca.example/dir", "https:"):
            problem = certificate._problem(rules.OrderFailed(trouble, "said"), RenewalRequest(DOMAIN, directory))
            assert str(problem).endswith(".")
            assert problem.advice
            assert problem.details == ("said",)


def test_other_commands_can_obtain_a_certificate(world, own, pebble):
    from hippodrome.deployment.aws.account import find_installation, open_account

    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
            patch.setenv(name, "testing")
        account = open_account(region="us-east-1")
        told = []
        report = certificate.obtain(
            account,
            find_installation(account),
            certificate.Choice(directory=pebble.directory, trusted=pebble.trusted),
            tell=told.append,
        )
    assert report.ordered
    assert report.days_left == 89
    assert told == list(rules.OrderStage)
    json.dumps(report.as_json())
