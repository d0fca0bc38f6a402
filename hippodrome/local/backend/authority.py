"""A certificate authority of this machine, for `run --tls`. Browsers that trust it trust names below localhost.

With `--host` it is another one, for that name or address. Its certificate allows it no other names (RFC 5280,
4.2.1.10), so its key is of no use to imitate other sites. Each name gets a certificate of its own: browsers and OpenSSL
do not accept `*.localhost`.
"""

from __future__ import annotations

import ipaddress
import os
import ssl
import tempfile
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

AUTHORITY_DAYS = 825
NAME_DAYS = 90
"""Days for which a name's certificate is valid. Each start makes new ones, so no run needs them for longer."""
_BACKDATED = timedelta(hours=1)  # certificates stay valid if the clock is set back
_COMMON_NAME = "Hippodrome on this machine"


class Authority:
    """A certificate authority of this machine, whose certificate and key are in `folder`. Raises OSError.

    A new one is made if there is none, if it is damaged, or if its certificate expires within NAME_DAYS. `host` is a
    name or an IPv4 address for which it may make certificates beside localhost's; each needs a folder of its own.
    """

    def __init__(self, folder: Path, host: str | None = None) -> None:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.certificate = folder / "authority.pem"
        """The file of the certificate that a browser must trust."""
        self._key_file = folder / "authority.key"
        self._folder = folder
        self._host = host
        loaded = self._load()
        self._own, self._key = loaded if loaded is not None else self._make()

    def context(self, *names: str) -> ssl.SSLContext:
        """Return a TLS context for a server, with a new certificate for these names and addresses."""
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        with tempfile.TemporaryDirectory(dir=self._folder) as place:  # readable by its owner alone
            file = Path(place) / "both.pem"
            _write_private(file, self._certify(names))
            context.load_cert_chain(file)
        return context

    def _certify(self, names: Sequence[str]) -> bytes:
        """A new certificate for these names, and its key, as PEM."""
        key = ec.generate_private_key(ec.SECP256R1())
        built = (
            _builder(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, names[0][:64])]), NAME_DAYS)
            .issuer_name(self._own.subject)
            .public_key(key.public_key())
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.SubjectAlternativeName([general_name(name) for name in names]), critical=False)
            .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key()), critical=False)
        )
        certificate = built.sign(self._key, hashes.SHA256())
        return certificate.public_bytes(serialization.Encoding.PEM) + _pem(key)

    def _load(self) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey] | None:
        """The authority in the folder; None if there is none, or if it is damaged or expires within NAME_DAYS."""
        try:
            own = x509.load_pem_x509_certificate(self.certificate.read_bytes())
            key = serialization.load_pem_private_key(self._key_file.read_bytes(), None)
        except (FileNotFoundError, ValueError):
            return None
        if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != own.public_key():
            return None
        if own.not_valid_after_utc < datetime.now(UTC) + timedelta(days=NAME_DAYS):
            return None
        self._key_file.chmod(0o600)
        return own, key

    def _make(self) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
        key = ec.generate_private_key(ec.SECP256R1())
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, _COMMON_NAME)])
        here = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_network("127.0.0.0/8"))]
        if self._host is not None:
            host_name = general_name(self._host)
            is_name = isinstance(host_name, x509.DNSName)
            here.append(host_name if is_name else x509.IPAddress(ipaddress.ip_network(self._host)))
        own = (
            _builder(name, AUTHORITY_DAYS)
            .issuer_name(name)
            .public_key(key.public_key())
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(x509.NameConstraints(here, None), critical=True)
            .add_extension(SIGNS_CERTIFICATES, critical=True)
            # It signs no certificates for e-mail or code.
            .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
            .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
            .sign(key, hashes.SHA256())
        )
        _write_private(self._key_file, _pem(key))
        self.certificate.write_bytes(own.public_bytes(serialization.Encoding.PEM))
        return own, key


SIGNS_CERTIFICATES = x509.KeyUsage(
    digital_signature=False,
    content_commitment=False,
    key_encipherment=False,
    data_encipherment=False,
    key_agreement=False,
    key_cert_sign=True,
    crl_sign=False,
    encipher_only=False,
    decipher_only=False,
)


def _builder(subject: x509.Name, days: int) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + timedelta(days=days))
    )


def general_name(name: str) -> x509.GeneralName:
    """Return the DNS name or IP address as an entry of a certificate."""
    try:
        return x509.IPAddress(ipaddress.ip_address(name))
    except ValueError:
        return x509.DNSName(name)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _write_private(file: Path, content: bytes) -> None:
    """Write a file that its owner alone can read, from its first byte on."""
    file.unlink(missing_ok=True)
    with os.fdopen(os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as opened:
        opened.write(content)
