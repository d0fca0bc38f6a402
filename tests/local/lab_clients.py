"""A program that sends bots through a study of a lab's server: `python lab_clients.py LINK NUMBER [AUTHORITY]`.

It prints the bots' reports as JSON. Each bot opens the lab's link, as a browser does, and then its own signed link.
"""

from __future__ import annotations

import asyncio
import json
import ssl
import sys
from random import Random
from typing import Any
from urllib.parse import parse_qs, urljoin, urlsplit

import httpx

from hippodrome.bots.bot import Bot


class OneHost:
    """Allows the pages and servers of one host and port (`bots.addresses.AllowedAddresses`)."""

    def __init__(self, link: str, tls: ssl.SSLContext | None) -> None:
        self.netloc = urlsplit(link).netloc
        self.tls = tls

    def page(self, address: str) -> str:
        assert urlsplit(address).netloc == self.netloc, address
        return address

    server = page

    def dial(self, host: str, port: int) -> tuple[str, int]:
        return host, port


def own_link(link: str, tls: ssl.SSLContext | None = None) -> tuple[str, str]:
    """Open the lab's link. Return the signed link of the new participant, and their id."""
    answer = httpx.get(link, verify=tls or True, timeout=30)
    assert answer.status_code == 303, answer.text
    own = urljoin(link, answer.headers["location"])
    return own, parse_qs(urlsplit(own).query)["userId"][0]


async def send(link: str, number: int, tls: ssl.SSLContext | None = None) -> list[dict[str, Any]]:
    """Send so many bots through the study at once, and return their reports."""
    bots = []
    for seed in range(number):
        own, user_id = await asyncio.to_thread(own_link, link, tls)
        bots.append(Bot(own, user_id, Random(seed), play=1.0, patience=120.0, allowed=OneHost(link, tls)))
    reports = await asyncio.gather(*(bot.run() for bot in bots))
    return [
        {
            "user": one.user_id,
            "finished": one.finished,
            "errors": one.errors,
            "played": [play.addresses for play in one.plays],
        }
        for one in reports
    ]


if __name__ == "__main__":
    trusted = ssl.create_default_context(cafile=sys.argv[3]) if len(sys.argv) > 3 else None
    print(json.dumps(asyncio.run(send(sys.argv[1], int(sys.argv[2]), trusted))))
