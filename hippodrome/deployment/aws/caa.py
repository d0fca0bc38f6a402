"""CAA records: which certificate authorities may issue certificates for a domain (RFC 8659)."""

# ruff: noqa: PLC0415 - dnspython is imported where DNS is asked: few commands ask it

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from hippodrome.deployment.aws import hosted_zone

AMAZON = ("amazon.com", "amazontrust.com", "awstrust.com", "amazonaws.com")
"""Amazon's names in CAA records. Any of them lets ACM issue (ACM's user guide, "(Optional) Configure a CAA record")."""
LETS_ENCRYPT = ("letsencrypt.org",)
"""Let's Encrypt's name in CAA records (its page "Certificate Authority Authorization (CAA)")."""

Record = tuple[str, str]  # tag and value


@dataclass(frozen=True)
class Caa:
    """The CAA records that apply to a name.

    `where` is the domain that has them: the name itself or the nearest domain above it; "" if no record applies.
    """

    where: str = ""
    records: tuple[Record, ...] = ()
    certain: bool = True  # False: DNS could not be asked

    def forbidding(self, authorities: Sequence[str], *, wildcard: bool, acme: bool = False) -> list[Record]:
        """Return the records by which none of these authorities may issue; empty if one of them may issue.

        For a wildcard, `issuewild` counts instead of `issue` if there is any (section 4.3). With `acme`, an authority
        may issue only if it may validate by DNS-01 (RFC 8657).
        """
        wild = [record for record in self.records if record[0] == "issuewild"] if wildcard else []
        counting = wild or [record for record in self.records if record[0] == "issue"]
        allowed = any(_allows(value, authority, acme) for _, value in counting for authority in authorities)
        return [] if allowed else counting


def find(name: str, exists: Callable[[str], bool] = lambda name: True) -> Caa:
    """Ask DNS for the records that apply to a name: its own, or the records of the nearest domain above (section 3).

    `exists` says whether a name exists. DNS is not asked for a name that does not
    (`hippodrome.deployment.aws.hosted_zone.exists` says why). Raises only what `exists` raises.
    """
    import dns.exception
    import dns.resolver

    resolver = hosted_zone.resolver()
    labels = name.split(".")
    for start in range(len(labels)):
        above = ".".join(labels[start:])
        if not exists(above):
            continue
        try:
            answer = resolver.resolve(f"{above}.", "CAA")
        except (dns.resolver.NXDOMAIN, dns.resolver.NoAnswer):
            continue
        except (dns.exception.DNSException, OSError, ValueError):
            return Caa(certain=False)
        return Caa(above, tuple((_plain(entry.tag).lower(), _plain(entry.value)) for entry in answer))
    return Caa()


def _allows(value: str, authority: str, acme: bool) -> bool:
    """Whether the value of an issue or issuewild record allows the authority to issue; with `acme`, by DNS-01."""
    issuer, *parameters = (part.strip() for part in value.split(";"))
    if issuer.lower() != authority:
        return False
    for parameter in parameters if acme else ():
        key, _, content = parameter.partition("=")
        if key.strip().lower() == "validationmethods":
            return "dns-01" in [method.strip().lower() for method in content.split(",")]
    return True


def _plain(raw: bytes) -> str:
    text = raw.decode(errors="replace")
    return "".join(c if c.isprintable() else "?" for c in text)
