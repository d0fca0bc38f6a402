"""Takes over the servers' certificate of an earlier installation that was removed.

`destroy` keeps the data bucket, with the certificate in it; the next installation has a bucket of its own. Ordering
anew each time would meet Let's Encrypt's limit of five certificates for the same names in seven days (see
`hippodrome.control.certificates.rules`). So this copies a certificate that is not due for renewal, and the key of the
ACME account that renews it, from the kept bucket to the new one, with the administrator's rights. Both buckets are
private.
"""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.control.certificates.rules import ACCOUNT, PRODUCTION, StoredCertificate, names_of, renew_at
from hippodrome.control.ports import Conflict, Documents
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.stack import inventory

if TYPE_CHECKING:
    from collections.abc import Iterator


def take_over(account: Account, installation: Installation) -> StoredCertificate | None:
    """Copy a certificate of an earlier installation, if this one has none. Return the copied certificate, or None.

    `Renewal.obtain` writes the rest (`fullchain.pem`, `certificate.json`) from it.
    """
    from hippodrome.control.certificates.order import read_stored  # noqa: PLC0415 - imports cryptography, which takes its time

    documents, privkey = account.platform(installation).documents, installation.certificate.privkey
    if documents.get(privkey) is not None:
        return None
    names, now = names_of(installation.servers_domain), datetime.now(UTC)
    stored_certificates: list[tuple[StoredCertificate, str, bytes]] = []
    for bucket in _kept(account, installation):
        body = _read(account, bucket, privkey)
        stored = read_stored(body) if body else None
        if stored and stored.names == names and now < renew_at(stored.not_before, stored.not_after):
            stored_certificates.append((stored, bucket, body))
    if not stored_certificates:
        return None
    stored, bucket, body = max(
        stored_certificates, key=lambda candidate: (candidate[0].directory == PRODUCTION, candidate[0].not_after)
    )
    _write(documents, ACCOUNT, _read(account, bucket, ACCOUNT))
    if not _write(documents, privkey, body):
        return None
    screen.success(
        f"The certificate of the installation before this one is taken over from the bucket {bucket}: it is valid "
        f"until {stored.not_after.astimezone():%Y-%m-%d}."
    )
    return stored


def _kept(account: Account, installation: Installation) -> Iterator[str]:
    """Yield the names of the data buckets of earlier installations with this name in this region."""
    for bucket in inventory.data_buckets(account, installation.stack):
        if bucket != installation["Bucket"]:
            yield bucket


def _read(account: Account, bucket: str, key: str) -> bytes:
    """Read a document. Return empty if there is none, or S3 refuses: then a new certificate is ordered."""
    try:
        answer = account.client("s3").get_object(Bucket=bucket, ExpectedBucketOwner=account.id, Key=key)
    except ClientError:
        return b""
    return bytes(answer["Body"].read())


def _write(documents: Documents, key: str, body: bytes) -> bool:
    """Create a document. Return False if it exists by now, or `body` is empty."""
    try:
        if body:
            documents.create(key, body)
    except Conflict:
        return False
    return bool(body)
