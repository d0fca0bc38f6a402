"""A name server on loopback that answers with the records that a test chooses."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator, Mapping, Sequence

import dns.flags
import dns.message
import dns.rcode
import dns.rdataclass
import dns.rdatatype
import dns.resolver
import dns.rrset
import pytest

Records = Mapping[tuple[str, str], Sequence[str]]
SERVFAIL = ("SERVFAIL",)  # in the place of records: the name servers of this name do not answer


@contextlib.contextmanager
def answering(records: Records, asked: set[str] | None = None) -> Iterator[int]:
    """Answer over UDP; a name without any records does not exist. Yields the port; the questions are added to `asked`."""
    names = {name for name, _ in records}
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))

        def serve() -> None:
            while True:
                data, sender = server.recvfrom(4096)
                if not data:
                    return
                query = dns.message.from_wire(data)
                question = query.question[0]
                name, kind = question.name.to_text().rstrip(".").lower(), dns.rdatatype.to_text(question.rdtype)
                if asked is not None:
                    asked.add(name)
                answer = dns.message.make_response(query)
                answer.flags |= dns.flags.RA
                found = records.get((name, kind))
                if found == SERVFAIL:
                    answer.set_rcode(dns.rcode.SERVFAIL)
                elif found:
                    answer.answer.append(dns.rrset.from_text(question.name, 60, "IN", kind, *found))
                elif not any(known == name or known.endswith(f".{name}") for known in names):
                    answer.set_rcode(dns.rcode.NXDOMAIN)
                server.sendto(answer.to_wire(), sender)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1]
        finally:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
                end.sendto(b"", ("127.0.0.1", server.getsockname()[1]))
            thread.join()


def ask_only(monkeypatch: pytest.MonkeyPatch, port: int) -> None:
    """Let every resolver ask only this name server."""

    class Resolver(dns.resolver.Resolver):
        def __init__(self, *_: object, **__: object) -> None:
            super().__init__(configure=False)
            self.nameservers, self.port = ["127.0.0.1"], port

    monkeypatch.setattr(dns.resolver, "Resolver", Resolver)
