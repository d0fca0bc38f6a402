"""What `Route53Dns` asks of Route 53, and what it makes of its answers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import pytest
from botocore.exceptions import ClientError

from hippodrome.control.aws import retry
from hippodrome.control.model import ids
from hippodrome.control.ports import DnsRecord, RefusedDnsRecords, ServiceBusy
from testing.moto_world import MotoWorld


def _record(n: int, host: str | None = None) -> DnsRecord:
    name = ids.server_name(ids.server_label("study", f"P{n}"), 1)
    return DnsRecord(f"{name}.servers.example.org", host or f"203.0.{n // 250}.{n % 250 + 1}")


RECORDS = [_record(n) for n in range(4)]


def test_one_change_for_the_whole_batch(moto_world: MotoWorld) -> None:
    names = moto_world.platform.dns
    names.change(add=RECORDS[:2])
    names.change(add=RECORDS[2:], remove=RECORDS[:2])
    assert moto_world.actions == ["route53:ChangeResourceRecordSets"] * 2
    changes = moto_world.calls[1].params["ChangeBatch"]["Changes"]
    assert [change["Action"] for change in changes] == ["DELETE", "DELETE", "UPSERT", "UPSERT"]
    assert {change["ResourceRecordSet"]["TTL"] for change in changes} == {60}
    assert moto_world.records() == {r.name: r.host for r in RECORDS[2:]}


def test_a_change_that_moves_a_name_does_not_also_remove_it(moto_world: MotoWorld) -> None:
    """Route 53 refuses a change that names one record twice."""
    names = moto_world.platform.dns
    names.change(add=RECORDS[:2])
    moved = [_record(0, "198.51.100.1"), RECORDS[1]]
    with moto_world.recording() as calls:
        names.change(add=moved, remove=RECORDS[:2])
    changes = [change for call in calls for change in call.params["ChangeBatch"]["Changes"]]
    assert [(change["Action"], change["ResourceRecordSet"]["Name"]) for change in changes] == [
        ("UPSERT", record.name) for record in moved
    ]
    assert moto_world.records() == {record.name: record.host for record in moved}


def test_a_large_change_is_sent_in_parts_and_is_in_sync_when_all_parts_are(moto_world: MotoWorld) -> None:
    names = moto_world.platform.dns
    change = names.change(add=[_record(n) for n in range(801)])
    assert [len(call.params["ChangeBatch"]["Changes"]) for call in moto_world.calls] == [400, 400, 1]
    with moto_world.recording() as calls:
        assert names.in_sync(change)
    assert [call.operation for call in calls] == ["GetChange"] * 3
    moto_world.answer("route53:GetChange", {"ChangeInfo": {"Id": "C1", "Status": "PENDING"}})
    assert not names.in_sync(change)
    assert len(list(names.list())) == 801


def test_names_that_no_longer_exist_are_left_out_and_the_rest_is_sent_again(moto_world: MotoWorld) -> None:
    names = moto_world.platform.dns
    names.change(add=RECORDS[:2])
    with moto_world.recording() as calls:
        change = names.change(add=RECORDS[3:], remove=RECORDS[:3])
    assert [len(call.params["ChangeBatch"]["Changes"]) for call in calls] == [4, 3]
    assert names.in_sync(change)
    assert moto_world.records() == {RECORDS[3].name: RECORDS[3].host}


def test_when_all_names_are_gone_there_is_no_change_to_wait_for(moto_world: MotoWorld) -> None:
    names = moto_world.platform.dns
    assert names.change(remove=RECORDS) == ""
    with moto_world.recording() as calls:
        assert names.in_sync("")
    assert calls == []


def test_after_a_refusal_in_unknown_words_the_rest_of_the_change_still_succeeds(moto_world: MotoWorld) -> None:
    names = moto_world.platform.dns
    names.change(add=RECORDS[:2])
    moto_world.fail("route53:ChangeResourceRecordSets", "InvalidChangeBatch", "Something is wrong here")
    change = names.change(add=RECORDS[3:], remove=RECORDS[:3])
    assert names.in_sync(change)
    assert moto_world.records() == {RECORDS[3].name: RECORDS[3].host}


def test_escaped_names_in_a_refusal_are_recognized(moto_world: MotoWorld) -> None:
    moto_world.fail(
        "route53:ChangeResourceRecordSets",
        "InvalidChangeBatch",
        f"[Tried to delete resource record set [name='{RECORDS[0].name.upper().replace('-', chr(92) + '055')}.', "
        "type='A'] but it was not found]",
    )
    assert moto_world.platform.dns.change(remove=RECORDS[:1]) == ""
    assert len(moto_world.calls) == 1


def test_the_messages_of_a_refusal_may_come_as_a_list(moto_world: MotoWorld) -> None:
    sentence = f"Tried to delete resource record set [name='{RECORDS[0].name}.', type='A'] but it was not found"
    moto_world.fail("route53:ChangeResourceRecordSets", "InvalidChangeBatch", "", messages=[sentence])
    assert moto_world.platform.dns.change(remove=RECORDS[:1]) == ""


@pytest.mark.parametrize("code", ["PriorRequestNotComplete", "Throttling"])
def test_a_change_of_a_busy_zone_is_tried_a_limited_number_of_times(
    moto_world: MotoWorld, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retry, "FIRST", 0.0)
    names = moto_world.platform.dns
    moto_world.fail("route53:ChangeResourceRecordSets", code, times=retry.MAX_TRIES - 1)
    names.change(add=RECORDS[:1])
    assert list(names.list()) == RECORDS[:1]
    moto_world.fail("route53:ChangeResourceRecordSets", code, times=retry.MAX_TRIES)
    with pytest.raises(ServiceBusy):
        names.change(remove=RECORDS[:1])


def test_tries_of_a_busy_zone_end_after_a_limited_time() -> None:
    clock = SimpleNamespace(now=0.0)

    def act() -> None:
        clock.now += 3.0  # the time that botocore takes for its own tries
        raise TimeoutError

    def sleep(seconds: float) -> None:
        clock.now += seconds

    with pytest.raises(ServiceBusy):
        retry.retry_while_busy(act, lambda error: True, sleep, lambda: 1.0, lambda: clock.now)
    assert 25 < clock.now <= retry.MAX_SECONDS + 3


def test_a_throttled_status_request_raises_service_busy(moto_world: MotoWorld) -> None:
    moto_world.fail("route53:GetChange", "Throttling", times=9)
    with pytest.raises(ServiceBusy):
        moto_world.platform.dns.in_sync("C1")


@pytest.mark.parametrize("code", ["AccessDenied", "NoSuchHostedZone"])
def test_other_errors_are_raised_unchanged(moto_world: MotoWorld, code: str) -> None:
    moto_world.fail("route53:ChangeResourceRecordSets", code)
    with pytest.raises(ClientError, match=code):
        moto_world.platform.dns.change(add=RECORDS)


def test_a_deleted_zone_has_no_names(moto_world: MotoWorld) -> None:
    """So that servers can still be stopped; additions fail."""
    names = moto_world.platform.dns
    moto_world.fail("route53:ListResourceRecordSets", "NoSuchHostedZone")
    assert list(names.list()) == []
    moto_world.fail("route53:ChangeResourceRecordSets", "NoSuchHostedZone", times=2)
    assert names.change(remove=RECORDS) == ""
    with pytest.raises(ClientError, match="NoSuchHostedZone"):
        names.change(add=RECORDS[:1], remove=RECORDS[1:])


TOO_LONG = DnsRecord(f"{'x' * 64}.example.org", "203.0.113.9")
WORDS = {
    "InvalidChangeBatch": f"FATAL problem: DomainLabelTooLong (Domain label is too long) encountered with '{'x' * 64}'",
    "InvalidInput": "Invalid Resource Record",
}


def refusing(world: MotoWorld, code: str, wrong: Callable[[str], bool]) -> None:
    """From now on Route 53 refuses, as a whole, every batch that would add a name for which `wrong` is true."""

    def added(params: Mapping[str, Any]) -> bool:
        changes = params["ChangeBatch"]["Changes"]
        return any(wrong(c["ResourceRecordSet"]["Name"]) for c in changes if c["Action"] == "UPSERT")

    world.refuse("route53:ChangeResourceRecordSets", added, code, WORDS[code])


@pytest.mark.parametrize("code", WORDS)
def test_a_refused_name_does_not_prevent_the_others(moto_world: MotoWorld, code: str) -> None:
    refusing(moto_world, code, lambda name: name == TOO_LONG.name)
    names, many = moto_world.platform.dns, [_record(n) for n in range(40)]
    names.change(add=many[:1])
    with moto_world.recording() as calls, pytest.raises(RefusedDnsRecords) as refused:
        names.change(add=[*many[1:30], TOO_LONG, *many[30:]], remove=many[:1])
    assert refused.value.records == (TOO_LONG,)
    assert moto_world.records() == {record.name: record.host for record in many[1:]}
    assert names.in_sync(refused.value.change)
    assert len(calls) <= 12, "halves, and not forty calls"
    assert "x" * 64 not in str(refused.value), "a name may be an id"


def test_a_name_with_a_record_of_another_type_does_not_prevent_the_others(moto_world: MotoWorld) -> None:
    taken = DnsRecord("www.example.org", "203.0.113.9")
    alias = {"Name": taken.name, "Type": "CNAME", "TTL": 60, "ResourceRecords": [{"Value": "example.com"}]}
    moto_world.client("route53").change_resource_record_sets(
        HostedZoneId=moto_world.ids["zone"],
        ChangeBatch={"Changes": [{"Action": "CREATE", "ResourceRecordSet": alias}]},
    )
    with pytest.raises(RefusedDnsRecords) as refused:
        moto_world.platform.dns.change(add=[taken, TOO_LONG, *RECORDS])
    assert set(refused.value.records) == {taken, TOO_LONG}
    assert list(moto_world.platform.dns.list()) == sorted(RECORDS)


def test_when_all_names_are_refused_there_is_no_change_to_wait_for(moto_world: MotoWorld) -> None:
    refusing(moto_world, "InvalidInput", lambda name: True)
    with pytest.raises(RefusedDnsRecords) as refused:
        moto_world.platform.dns.change(add=RECORDS)
    assert (set(refused.value.records), refused.value.change) == (set(RECORDS), "")


def test_a_removal_that_is_refused_in_unknown_words_is_an_error(moto_world: MotoWorld) -> None:
    moto_world.fail("route53:ChangeResourceRecordSets", "InvalidChangeBatch", "Something is wrong here", times=9)
    with pytest.raises(ClientError, match="wrong here"):
        moto_world.platform.dns.change(remove=RECORDS[:2])


def test_only_servers_names_are_listed(moto_world: MotoWorld) -> None:
    label = RECORDS[0].name.partition(".")[0]
    others = [
        ("www.example.org", "A", ["203.0.113.1"]),
        ("example.org", "A", ["203.0.113.1"]),
        (f"{label}.deeper.servers.example.org", "A", ["203.0.113.1"]),
        (f"_acme.{label}.servers.example.org", "TXT", ['"x"']),
        (f"{label[:-1]}2.servers.example.org", "A", ["203.0.113.1", "203.0.113.2"]),
        (f"{label[:-1]}3.servers.example.org", "AAAA", ["2001:db8::1"]),
        ("*.example.org", "A", ["203.0.113.1"]),
    ]
    changes = [
        {
            "Action": "UPSERT",
            "ResourceRecordSet": {
                "Name": name,
                "Type": kind,
                "TTL": 60,
                "ResourceRecords": [{"Value": value} for value in values],
            },
        }
        for name, kind, values in others
    ]
    moto_world.client("route53").change_resource_record_sets(
        HostedZoneId=moto_world.ids["zone"], ChangeBatch={"Changes": changes}
    )
    moto_world.platform.dns.change(add=RECORDS[:1])
    assert list(moto_world.platform.dns.list()) == RECORDS[:1]


def test_only_names_directly_below_the_servers_domain_are_listed(moto_world: MotoWorld) -> None:
    label = "s" + "a" * 20
    ours = [f"{label}-1.servers.example.org", f"{label}-2.servers.example.org"]
    others = [
        f"{label}-2.example.org",
        f"{label}-3.other.example.org",
        f"{label}-4.a.servers.example.org",
        "alice.servers.example.org",
    ]
    names = moto_world.platform.dns
    names.change(add=[DnsRecord(name, "203.0.113.9") for name in (*ours, *others)])
    assert sorted(record.name for record in names.list()) == sorted(ours)


def test_names_of_the_listing_are_unescaped(moto_world: MotoWorld) -> None:
    escaped = RECORDS[0].name.replace("-", "\\055")
    record = {"Name": f"{escaped}.", "Type": "A", "TTL": 60, "ResourceRecords": [{"Value": RECORDS[0].host}]}
    alias = {"Name": "\\052.example.org.", "Type": "A", "AliasTarget": {"DNSName": "x."}}
    answer = {"ResourceRecordSets": [alias, record], "IsTruncated": False, "MaxItems": "300"}
    moto_world.answer("route53:ListResourceRecordSets", answer)
    assert list(moto_world.platform.dns.list()) == RECORDS[:1]
