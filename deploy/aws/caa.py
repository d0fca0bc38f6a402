"""CAA records: which certificate authorities the owner of a domain lets issue certificates (RFC 8659)."""

# ruff: noqa: PLC0415 - dnspython is imported where DNS is asked: few commands ask it

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from deploy.aws import hosted_zone

AMAZON = ("amazon.com", "amazontrust.com", "awstrust.com", "amazonaws.com")
"""Any of them lets ACM issue (ACM's user guide, "(Optional) Configure a CAA record")."""
LETS_ENCRYPT = ("letsencrypt.org",)
"""Let's Encrypt's page "Certificate Authority Authorization (CAA)"."""

Record = tuple[str, str]  # tag and value


@dataclass(frozen=True)
class Caa:
    """The records that apply to a name: those of `where`, the nearest domain upwards that has any; "" if none has."""

    where: str = ""
    records: tuple[Record, ...] = ()
    certain: bool = True  # False: DNS could not be asked

    def forbidding(self, authorities: Sequence[str], *, wildcard: bool, acme: bool = False) -> list[Record]:
        """The records that keep all these authorities from issuing; none if one of them may issue.

        For a wildcard `issuewild` counts instead of `issue`, where there is any (section 4.3). `acme`: by DNS-01.
        """
        wild = [record for record in self.records if record[0] == "issuewild"] if wildcard else []
        counting = wild or [record for record in self.records if record[0] == "issue"]
        allowed = any(_allows(value, one, acme) for _, value in counting for one in authorities)
        return [] if allowed else counting


def find(name: str, known: Callable[[str], bool] = lambda name: True) -> Caa:
    """The records that apply to a name (section 3: up the tree, to the first name that has some).

    `known`: whether a name exists; those that do not have no records, and DNS is not asked for them
    (`deploy.aws.hosted_zone.exists` says why). Raises nothing that `known` does not raise.
    """
    import dns.exception
    import dns.resolver

    resolver = dns.resolver.Resolver(configure=True)
    resolver.lifetime = hosted_zone.DNS_TIMEOUT
    labels = name.split(".")
    for start in range(len(labels)):
        above = ".".join(labels[start:])
        if not known(above):
            continue
        try:
            answer = resolver.resolve(f"{above}.", "CAA")
        except (dns.resolver.NXDOMAIN, dns.resolver.NoAnswer):
            continue
        except (dns.exception.DNSException, OSError, ValueError):
            return Caa(certain=False)
        return Caa(above, tuple((_plain(one.tag).lower(), _plain(one.value)) for one in answer))
    return Caa()


def _allows(value: str, authority: str, acme: bool) -> bool:
    """Whether the value of an issue or issuewild record names the authority; with `acme`, for DNS-01 (RFC 8657)."""
    who, *parameters = (part.strip() for part in value.split(";"))
    if who.lower() != authority:
        return False
    for parameter in parameters if acme else ():
        key, _, content = parameter.partition("=")
        if key.strip().lower() == "validationmethods":
            return "dns-01" in [method.strip().lower() for method in content.split(",")]
    return True


def _plain(raw: bytes) -> str:
    text = raw.decode(errors="replace")
    return "".join(c if c.isprintable() else "?" for c in text)
