"""Turns events of the HTTP API into requests, and responses into events; an exception becomes a page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hippodrome.control import http
from hippodrome.control.http import Request, Response
from hippodrome.control.log import failure

_NO_STEP = '<input type="hidden" name="hippodrome-step" value="">'
"""HIPPO's front end puts a button below the page. With this field, the button's form answers no step: the page of
the due step follows."""

_HEAD = (
    '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    "<style>body { max-width: 40rem; margin: 3rem auto; padding: 0 1rem; font: 1.1rem/1.5 sans-serif }</style>"
)


def respond(event: Mapping[str, Any], respond: Callable[[Request], Response]) -> dict[str, Any]:
    """Call `respond` with the request in the event. If it raises, return a page of one sentence, with status 500.

    A front end of another site gets status 200 instead, because HIPPO's waits without end after a 500
    (`participants/page_error.py`).
    """
    request = Request.from_event(event)
    try:
        return respond(request).to_event(request.accepts_gzip, https=request.is_https)
    except Exception as error:  # noqa: BLE001 - whatever it was, the participant gets a page
        failure("request failed", error, method=request.method)
        return _error_page(request).to_event(https=request.is_https)


def _error_page(request: Request) -> Response:
    text = "Something went wrong on our side. Wait a moment, then reload this page to try again: it sends your answers."
    if request.wants_json:
        page = f"{_NO_STEP}<p>{text}</p>"
        return http.as_json(200 if request.is_front_end else 500, {"page": page, "css": None, "message": text})
    return http.html(500, f'<!doctype html><html lang="en">{_HEAD}<title>Please try again</title><p>{text}</p>')
