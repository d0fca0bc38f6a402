"""Which requests this machine's web server answers: those of its own pages, of people who open a link, and of programs.

A page of another site that is open in the researcher's browser can send requests to this machine, too. Browsers say so:
in `Origin` (https://fetch.spec.whatwg.org/#origin-header) and `Sec-Fetch-Site`, `-Dest`
(https://www.w3.org/TR/fetch-metadata/). A name of the other site's that leads to this machine (DNS rebinding) stands in
`Host`. Programs that are no browsers send neither and may ask.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from urllib.parse import urlsplit

NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""What this machine is called in its own addresses; at any port, which a tunnel may have changed."""


TLS_NAMES = frozenset({"study.localhost", "api.localhost"})
"""Further names with TLS: the site's as on AWS, and the one that HIPPO's front end at `localhost` asks."""


def refusal(
    method: str, path: str, headers: Mapping[str, str], origins: Collection[str] = (), *, scheme: str = "http"
) -> str | None:
    """Why the request is not answered, in a sentence; None if it is. Names of headers are in lower case.

    `origins` are the other origins whose pages may ask, such as `http://localhost:3000`.
    """
    host = headers.get("host", "")
    if _name(host) not in (NAMES | TLS_NAMES if scheme == "https" else NAMES):
        return "This server answers to the names of this machine only, such as 127.0.0.1."
    origin, site = headers.get("origin"), headers.get("sec-fetch-site")
    if origin in origins:
        return None
    if method not in ("GET", "HEAD"):
        own = origin is None or origin.lower() == f"{scheme}://{host.lower()}"
        if not own and not (origin == "null" and site == "same-origin"):
            return "Pages of other sites may not send anything to this server; --origin names those that may."
    elif (
        site in ("cross-site", "same-site")
        and headers.get("sec-fetch-dest") != "document"
        and not path.startswith("/steps/")
    ):
        return "Pages of other sites may not load this; --origin names those that may."
    return None


def headers_for(origin: str | None, sent: Collection[tuple[str, str]], origins: Collection[str]) -> dict[str, str]:
    """The headers of a response as they leave this machine.

    On AWS any origin may read the answers, since only participants have their links. Here a study's id is
    enough, so the functions' CORS headers are for `origins` only. The referrer is kept within our pages, so that they
    send an `Origin` with their forms; browsers that must not send a referrer write `null` there.
    """
    kept = dict(sent)
    if kept.get("referrer-policy") == "no-referrer":
        kept["referrer-policy"] = "same-origin"
    if not any(name.startswith("access-control-") for name in kept):
        return kept
    if origin is not None and origin in origins:
        return {
            **kept,
            "access-control-allow-origin": origin,
            "vary": ", ".join(filter(None, [kept.get("vary"), "Origin"])),
        }
    return {name: value for name, value in kept.items() if not name.startswith("access-control-")}


def origin_of(address: str) -> str | None:
    """The origin that an address names, as browsers write it; None if the text names no origin."""
    try:
        parts = urlsplit(address)
        port = f":{parts.port}" if parts.port else ""
    except ValueError:
        return None
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.path not in ("", "/") or parts.query:
        return None
    return f"{parts.scheme}://{parts.hostname}{port}"


def _name(host: str) -> str:
    """The name in a `Host` header, without the port; empty if it is none."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
