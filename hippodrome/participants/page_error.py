"""The exception that ends a request with a page of one sentence."""

from __future__ import annotations

from hippodrome import http
from hippodrome.http import Request, Response
from hippodrome.participants import frame


class PageError(Exception):
    """Respond with this title and text, to a program as JSON. `status` is the HTTP status."""

    def __init__(self, status: int, title: str, text: str) -> None:
        super().__init__(title)
        self.status, self.title, self.text = status, title, text

    def response(self, request: Request) -> Response:
        """The page, or JSON for a program."""
        if request.wants_json:
            return http.as_json(self.status, {"message": f"{self.title}. {self.text}"})
        page = frame.message_page(self.title, self.text)
        return http.html(self.status, page.html, page.headers)
