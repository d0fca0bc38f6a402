"""Requests are read from API Gateway's events, and responses are written as its events."""

from __future__ import annotations

import base64
import gzip
import json
from typing import Any

import pytest

from hippodrome.control import http
from hippodrome.control.http import Request, Response


def request(query: str = "", **headers: str) -> Request:
    named = {name.replace("_", "-"): value for name, value in headers.items()}
    return Request.from_event({"rawPath": "/next", "rawQueryString": query, "headers": named})


def test_an_event_becomes_a_request() -> None:
    event = {
        "rawPath": "/a",
        "rawQueryString": "x=1&y=&x=2",
        "headers": {"Content-Type": "text/plain"},
        "requestContext": {"http": {"method": "post"}},
        "body": "ä",
    }
    read = Request.from_event(event)
    assert (read.method, read.path, read.body) == ("POST", "/a", "ä".encode())
    assert read.query == (("x", "1"), ("y", ""), ("x", "2"))
    assert read.headers == {"content-type": "text/plain"}


@pytest.mark.parametrize("event", [{}, {"body": None, "headers": None, "rawQueryString": None, "rawPath": None}])
def test_an_empty_event_is_a_get_of_the_root(event: dict[str, Any]) -> None:
    assert Request.from_event(event) == Request("GET", "/", (), {}, b"") == Request("GET", "/", (), {})


@pytest.mark.parametrize(
    ("event", "method"),
    [
        ({"version": "2.0", "rawPath": "/a"}, "GET"),
        ({"requestContext": {"http": {"method": "PUT"}}, "rawPath": "/a"}, "PUT"),
    ],
)
def test_an_event_that_lacks_some_parts_is_read_by_those_it_has(event: dict[str, Any], method: str) -> None:
    read = Request.from_event(event)
    assert (read.method, read.path) == (method, "/a")


def test_a_request_in_a_log_shows_neither_its_headers_nor_its_body() -> None:
    assert "secret" not in repr(Request("POST", "/", (), {"cookie": "secret"}, b"secret"))


@pytest.mark.parametrize(
    ("body", "decoded"),
    [
        ("YQ==", b"a"),
        ("", b""),
        ("YQ=", None),
        ("Y Q==", None),
        ("ä", None),
        (base64.b64encode(b"\xff").decode(), b"\xff"),
    ],
)
def test_a_body_in_base64_is_decoded_or_marked_as_unreadable(body: str, decoded: bytes | None) -> None:
    assert Request.from_event({"body": body, "isBase64Encoded": True}).body == decoded


def test_a_header_that_is_not_utf_8_can_be_stored() -> None:
    """A web server of one machine hands such bytes on as halves of surrogate pairs."""
    assert Request.from_event({"headers": {"User-Agent": "A\udcff"}}).headers == {"user-agent": "A?"}


def test_half_of_a_surrogate_pair_in_a_body_becomes_bytes_that_are_no_text() -> None:
    assert Request.from_event({"body": "\ud800"}).body == b"\xed\xa0\x80"


@pytest.mark.parametrize("query", ["a=%ff", "a=\ud800", "&".join(["a=1"] * 65)])
def test_a_malformed_query_is_none_and_has_no_fields(query: str) -> None:
    read = request(query)
    assert read.query is None
    assert (read.query_value("a"), read.has_query("a"), read.url(b="1")) == (None, False, "/next?b=1")


def test_a_query_holds_up_to_64_fields() -> None:
    assert len(request("&".join(["a=1"] * 64)).query or ()) == 64


def test_a_field_counts_only_with_one_value() -> None:
    read = request("a=1&b=1&b=1&c=1&c=2&d=")
    assert [read.query_value(name) for name in "abcde"] == ["1", "1", None, "", None]
    assert [read.has_query(name) for name in "abcde"] == [True, True, True, True, False]


@pytest.mark.parametrize(("header", "kind"), [("Text/HTML; charset=utf-8", "text/html"), (" a/b ;c", "a/b"), ("", "")])
def test_a_content_type_is_read_without_its_parameters(header: str, kind: str) -> None:
    assert request(content_type=header).content_type == kind
    assert request().content_type == ""


@pytest.mark.parametrize(
    ("accept", "json"),
    [("application/json", True), ("text/html, application/json", False), ("*/*", False), ("text/html", False)],
)
def test_a_request_wants_json_if_its_accept_header_prefers_it(accept: str, json: bool) -> None:
    assert request(accept=accept).wants_json is json
    assert request().wants_json is False


@pytest.mark.parametrize(
    ("header", "accepted"),
    [
        ("gzip", True),
        ("deflate, GZIP , br", True),
        ("gzip;q=1.0", True),
        ("gzip; q=0.5", True),
        ("gzip;q=0", False),
        ("gzip;q=0.0", False),
        ("xgzip", False),
        ("gzipx", False),
        ("br", False),
        ("", False),
    ],
)
def test_gzip_is_accepted_if_the_header_says_so(header: str, accepted: bool) -> None:
    assert request(accept_encoding=header).accepts_gzip is accepted
    assert request().accepts_gzip is False


def test_a_page_of_another_site_that_asks_for_json_is_a_front_end() -> None:
    assert request(accept="application/json", origin="https://play.example.org").is_front_end is True
    assert request(accept="application/json").is_front_end is False
    assert request(accept="text/html", origin="https://play.example.org").is_front_end is False


@pytest.mark.parametrize(("header", "https"), [("https", True), (" HTTPS ", True), ("http", False), ("", False)])
def test_the_gateway_says_whether_a_browser_spoke_tls(header: str, https: bool) -> None:
    assert request(x_forwarded_proto=header).is_https is https
    assert request().is_https is False


def test_a_requests_own_url_keeps_the_query_and_never_names_another_host() -> None:
    assert request("a=1&b=2&a=3").url(b="x y") == "/next?a=1&a=3&b=x+y"
    assert Request("GET", "//evil.example/ä b\r\n", (), {}).url() == "/evil.example/%C3%A4%20b%0D%0A?"
    assert Request("GET", "\\/evil", (), {}).url() == "/evil?"
    assert Request("GET", "/a:@!$&'()*+,;=~", (), {}).url() == "/a:@!$&'()*+,;=~?"
    assert Request("GET", "/\ud800", (), {}).url() == "/%3F?"
    assert Request("GET", "/XX/next", (), {}).url() == "/XX/next?", "only slashes are taken away"


def test_every_response_has_the_headers_that_restrict_browsers() -> None:
    event = Response(404, "no", {"X-Other": "1", "Cache-Control": "no-store"}).to_event()
    assert event == {
        "statusCode": 404,
        "headers": {
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cache-Control": "no-store",
            "X-Other": "1",
        },
        "body": "no",
        "isBase64Encoded": False,
    }
    over_tls = Response(404, "no", {"X-Other": "1", "Cache-Control": "no-store"}).to_event(https=True)
    assert over_tls["headers"] == event["headers"] | {"Strict-Transport-Security": "max-age=63072000"}
    assert Response(200).to_event()["headers"]["Cache-Control"] == "private, no-cache"
    assert Response(200).to_event()["body"] == ""


def test_bytes_travel_in_base64() -> None:
    event = Response(200, b"\xff").to_event(compress=True)
    assert (event["body"], event["isBase64Encoded"]) == ("/w==", True)
    assert "Content-Encoding" not in event["headers"]


def test_texts_of_more_than_a_thousand_characters_travel_compressed_where_that_is_wanted() -> None:
    short, long = Response(200, "x" * 1000), Response(200, "x" * 1001)
    assert short.to_event(compress=True)["body"] == "x" * 1000
    assert long.to_event()["body"] == "x" * 1001
    event = long.to_event(compress=True)
    assert event["isBase64Encoded"]
    assert (event["headers"]["Content-Encoding"], event["headers"]["Vary"]) == ("gzip", "Accept-Encoding")
    assert gzip.decompress(base64.b64decode(event["body"])).decode() == "x" * 1001
    assert base64.b64decode(event["body"])[4:8] == bytes(4), "no time, so that a page has the same bytes each time"


def test_each_kind_of_response_has_its_status_body_and_headers() -> None:
    assert http.html(200, "<p>", {"A": "b"}) == Response(
        200, "<p>", {"Content-Type": "text/html; charset=utf-8", "A": "b"}
    )
    assert http.html(404, "").headers == {"Content-Type": "text/html; charset=utf-8"}
    data = http.as_json(202, {"a": [1]})
    assert (data.status, json.loads(str(data.body))) == (202, {"a": [1]})
    assert data.headers == {
        "Content-Type": "application/json",
        "Access-Control-Allow-Origin": "*",
        "Access-Control-Allow-Headers": "Content-Type",
        "Access-Control-Allow-Methods": "OPTIONS,GET,POST",
    }
    assert http.see_other("/x") == Response(303, "", {"Location": "/x"})
    assert http.found("/x") == Response(302, "", {"Location": "/x"})
