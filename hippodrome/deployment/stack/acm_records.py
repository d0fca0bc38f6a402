"""The DNS record that proves the site's name to ACM: CloudFormation makes it, and never deletes it.

Facts: `AWS::CertificateManager::Certificate` leaves its CNAME behind
(aws-cloudformation/cloudformation-coverage-roadmap issue 1603), and a zone that holds it cannot be deleted. The record
is made "specifically for your domain and your account" and "works for any AWS Region" (ACM user guide, DNS validation):
all certificates of an account for a name and its wildcard share it, in all regions. Without it none of them is renewed.

AWS does not tell the record's name any more once the certificate is deleted. So `remember` writes it into the code
bucket before the stack is deleted, and the code bucket is deleted last.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from botocore.exceptions import BotoCoreError, ClientError

from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.stack.code_bucket import CodeBucket

NOTE = "destroy/validation-records.json"  # the key of the note in the code bucket
KEY_TYPES = ("RSA_1024", "RSA_2048", "RSA_3072", "RSA_4096", "EC_prime256v1", "EC_secp384r1", "EC_secp521r1")
"""The key types for ListCertificates, which lists only RSA_1024 and RSA_2048 without them (ACM API reference)."""
_AT_ONCE = 8
_ACM = ".acm-validations.aws"
_GONE = {"ResourceNotFoundException", "NoSuchHostedZone"}


class Validation(NamedTuple):
    """A validation record: its hosted zone, and the CNAME's name and value."""

    zone: str
    name: str  # without the final dot, in lower case
    value: str

    @property
    def domain(self) -> str:
        """The domain for which the record validates certificates: for the name itself and its wildcard."""
        return self.name.partition(".")[2]


def of_certificate(account: Account, arn: str, zone: str) -> list[Validation]:
    """Ask ACM for the validation records of a certificate; empty if it is gone."""
    return [Validation(zone, name, value) for name, value in _records(_describe(account, arn, account.region))]


def remember(bucket: CodeBucket, validations: Iterable[Validation]) -> None:
    """Write into the code bucket which records have to be deleted after the stack."""
    earlier = remembered(bucket)
    wanted = list(dict.fromkeys([*earlier, *validations]))
    if wanted != earlier and bucket.exists():
        bucket.put(NOTE, json.dumps([validation._asdict() for validation in wanted]).encode())


def remembered(bucket: CodeBucket) -> list[Validation]:
    """Read the records that `remember` has written."""
    body = bucket.get(NOTE)
    return [Validation(**fields) for fields in json.loads(body)] if body else []


def present(account: Account, validation: Validation) -> dict[str, Any] | None:
    """Return the record in the zone; None if it is gone or has changed."""
    client = account.client("route53")
    try:
        answer = client.list_resource_record_sets(
            HostedZoneId=validation.zone, StartRecordName=f"{validation.name}.", StartRecordType="CNAME", MaxItems="1"
        )
    except ClientError as error:
        if errors.code(error) in _GONE:
            return None
        raise
    for record in answer["ResourceRecordSets"]:
        values = [_plain(item["Value"]) for item in record.get("ResourceRecords", ())]
        if _plain(record["Name"]) == validation.name and record["Type"] == "CNAME" and values == [validation.value]:
            return dict(record)
    return None


def of_domain(account: Account, zone: str, domain: str) -> list[Validation]:
    """Return all records in a zone that prove this domain to ACM, for any account."""
    if not domain:
        return []
    validations: list[Validation] = []
    try:
        pages = account.client("route53").get_paginator("list_resource_record_sets")
        for page in pages.paginate(HostedZoneId=zone, StartRecordName=f"{domain}."):
            for record in page["ResourceRecordSets"]:
                if _plain(record["Name"]) != domain and not _plain(record["Name"]).endswith(f".{domain}"):
                    return validations  # the listing has passed the domain: its subdomains follow it directly
                values = [_plain(item["Value"]) for item in record.get("ResourceRecords", ())]
                validation = Validation(zone, _plain(record["Name"]), values[0] if len(values) == 1 else "")
                if record["Type"] == "CNAME" and validation.domain == domain and validation.value.endswith(_ACM):
                    validations.append(validation)
    except ClientError as error:
        if errors.code(error) not in _GONE:
            raise
    return validations


def removal(zone: str, record: Mapping[str, Any]) -> str:
    """Return the AWS CLI command that deletes a record."""
    batch = json.dumps(deletion(record))
    return f"aws route53 change-resource-record-sets --hosted-zone-id {zone} --change-batch {shlex.quote(batch)}"


def deletion(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return the ChangeBatch that deletes a record."""
    return {"Changes": [{"Action": "DELETE", "ResourceRecordSet": record}]}


def remove(account: Account, validation: Validation) -> bool:
    """Delete the record. Return False if there was none."""
    record = present(account, validation)
    if record is None:
        return False
    try:
        account.client("route53").change_resource_record_sets(
            HostedZoneId=validation.zone, ChangeBatch=deletion(record)
        )
    except ClientError as error:
        if errors.code(error) not in {"InvalidChangeBatch", *_GONE}:  # another run was faster
            raise
    return True


def users(account: Account, validation: Validation) -> list[str]:
    """Find what needs the record: ARNs of this account's certificates; in words, regions that were not asked."""
    try:
        regions = _regions(account)
    except ClientError:
        return ["whatever is in other regions, which these credentials may not list"]
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        answers = pool.map(lambda region: [*_users_in(account, region, validation)], regions)
        return [user for users_of_region in answers for user in users_of_region]


def _regions(account: Account) -> Sequence[str]:
    """Return the regions that are enabled for this account."""
    return sorted(region["RegionName"] for region in account.client("ec2").describe_regions()["Regions"])


def _users_in(account: Account, region: str, validation: Validation) -> Iterator[str]:
    names = {validation.domain, f"*.{validation.domain}"}
    try:
        pages = account.client("acm", region).get_paginator("list_certificates")
        for page in pages.paginate(Includes={"keyTypes": list(KEY_TYPES)}):
            for summary in page["CertificateSummaryList"]:
                arn = summary["CertificateArn"]
                if _may_name(summary, names) and _needs(account, arn, region, validation):
                    yield arn
    except (ClientError, BotoCoreError):  # a region that the organization has forbidden, or that does not answer
        yield f"whatever is in {region}, where these credentials may not look"


def _may_name(certificate: dict[str, Any], names: Collection[str]) -> bool:
    listed = {certificate.get("DomainName", ""), *certificate.get("SubjectAlternativeNameSummaries", ())}
    return bool(listed & set(names)) or bool(certificate.get("HasAdditionalSubjectAlternativeNames"))


def _needs(account: Account, arn: str, region: str, validation: Validation) -> bool:
    """Whether the record validates the certificate. A certificate whose record ACM has not made yet counts as well."""
    described = _describe(account, arn, region)
    options = described.get("DomainValidationOptions", ())
    waiting = any(
        option.get("ValidationMethod") == "DNS"
        and "ResourceRecord" not in option
        and option["DomainName"].removeprefix("*.") == validation.domain
        for option in options
    )
    return waiting or any(name == validation.name for name, _ in _records(described))


def _describe(account: Account, arn: str, region: str) -> dict[str, Any]:
    try:
        return dict(account.client("acm", region).describe_certificate(CertificateArn=arn)["Certificate"])
    except ClientError as error:
        if errors.code(error) in _GONE | {"ValidationException"}:  # never made, so its physical id is no ARN
            return {}
        raise


def _records(described: dict[str, Any]) -> Iterator[tuple[str, str]]:
    for option in described.get("DomainValidationOptions", ()):
        if record := option.get("ResourceRecord"):
            yield _plain(record["Name"]), _plain(record["Value"])


def _plain(name: str) -> str:
    return name.rstrip(".").lower()
