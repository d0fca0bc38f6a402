"""Decides which requests the web server of this machine answers.

It answers its own pages, people who open a link, and programs. A page of another site that is open in the researcher's
browser can send requests to this machine, too. Browsers name that site in `Origin`
(https://fetch.spec.whatwg.org/#origin-header), and say in `Sec-Fetch-Site` and `Sec-Fetch-Dest` that it is another one
(https://www.w3.org/TR/fetch-metadata/). If the other site's own name leads to this machine (DNS rebinding), `Host` has
that name. Programs that are no browsers send no `Origin` and no `Sec-Fetch-` headers, and are answered.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from urllib.parse import urlsplit

NAMES = frozenset({"127.0.0.1", "localhost", "::1"})
"""Names and addresses of this machine. The port may be any: a tunnel may have changed it."""

TLS_NAMES = frozenset({"study.localhost", "api.localhost"})
"""Further names with TLS: the site's name, as on AWS, and the name to which HIPPO's front end sends its requests."""

_PORTS = {"http": 80, "https": 443}


def refusal(
    method: str,
    path: str,
    headers: Mapping[str, str],
    origins: Collection[str] = (),
    *,
    scheme: str = "http",
    any_name: bool = False,
) -> str | None:
    """Return the sentence with which a request is refused; None if it is answered.

    The names in `headers` are in lower case. `origins` are other origins whose pages are answered too, such as
    `http://localhost:3000`. With `any_name` the server has any name: that of a lab answers only who has a link.
    """
    host = headers.get("host", "")
    if not any_name and _name(host) not in (NAMES | TLS_NAMES if scheme == "https" else NAMES):
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


def headers_for(origin: str | None, sent: Mapping[str, str], origins: Collection[str]) -> dict[str, str]:
    """Return the headers to send with a response. `sent` are the headers that the function has returned.

    On AWS any origin may read responses, since only participants have their links. Here a study's id suffices, so only
    `origins` get the CORS headers. Pages of this server may send each other a referrer: without that, browsers send
    `Origin: null` with forms.
    """
    headers = dict(sent)
    if headers.get("referrer-policy") == "no-referrer":
        headers["referrer-policy"] = "same-origin"
    if not any(name.startswith("access-control-") for name in headers):
        return headers
    if origin is not None and origin in origins:
        return {
            **headers,
            "access-control-allow-origin": origin,
            "vary": ", ".join(filter(None, [headers.get("vary"), "Origin"])),
        }
    return {name: value for name, value in headers.items() if not name.startswith("access-control-")}


def origin_of(address: str) -> str | None:
    """Return the origin that an address names, as browsers write it: without the port that its scheme has by default.

    None if the text names no origin.
    """
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme not in _PORTS or not parts.hostname or parts.path not in ("", "/") or parts.query:
        return None
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    return f"{parts.scheme}://{host}" + (f":{port}" if port and port != _PORTS[parts.scheme] else "")


def _name(host: str) -> str:
    """The name in a `Host` header, without the port; empty if it cannot be parsed."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""
