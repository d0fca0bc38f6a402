"""Certificate authorities for tests and benches.

Their certificates have all extensions that RFC 5280 asks for, since Python's clients check them from version 3.13 on.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from hippodrome.local.backend.authority import SIGNS_CERTIFICATES, general_name

_AGO = timedelta(hours=1)  # so long before now all certificates begin to be valid


class CertificateAndKey(NamedTuple):
    """A certificate and its private key, both as PEM."""

    certificate: bytes
    key: bytes


@dataclass(frozen=True)
class SigningAuthority:
    """A certificate authority. `certificate` is its own certificate as PEM, which clients trust."""

    certificate: bytes
    _name: x509.Name
    _key: ec.EllipticCurvePrivateKey

    def issue(self, *names: str, serial: int | None = None, days: float = 60) -> CertificateAndKey:
        """Issue a certificate for these names and IP addresses, valid for so many days, with a new key."""
        key = ec.generate_private_key(ec.SECP256R1())
        made = _builder(_named(names[0]), key.public_key(), days, serial).issuer_name(self._name)
        made = made.add_extension(x509.SubjectAlternativeName([general_name(name) for name in names]), critical=False)
        made = made.add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False
        )
        secret = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        return CertificateAndKey(_pem(made.sign(self._key, hashes.SHA256())), secret)


def authority(name: str = "Test authority", days: float = 60) -> SigningAuthority:
    """Make a new authority with this common name, valid for so many days."""
    key, own = ec.generate_private_key(ec.SECP256R1()), _named(name)
    made = _builder(own, key.public_key(), days).issuer_name(own)
    made = made.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    made = made.add_extension(SIGNS_CERTIFICATES, critical=True)
    made = made.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    return SigningAuthority(_pem(made.sign(key, hashes.SHA256())), own, key)


def _builder(
    subject: x509.Name, public: ec.EllipticCurvePublicKey, days: float, serial: int | None = None
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .public_key(public)
        .serial_number(serial or x509.random_serial_number())
        .not_valid_before(now - _AGO)
        .not_valid_after(now + timedelta(days=days))
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])


def _pem(made: x509.Certificate) -> bytes:
    return made.public_bytes(serialization.Encoding.PEM)
