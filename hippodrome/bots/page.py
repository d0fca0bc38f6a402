"""The page of a study, as a bot reads it."""

from __future__ import annotations

import html
import json
import re
from dataclasses import dataclass
from typing import Any

from hippodrome.bots import forms
from hippodrome.control.participants import markup


@dataclass(frozen=True)
class VisitedPage:
    """A page of the study; `text` is its HTML."""

    address: str
    text: str

    @property
    def game(self) -> dict[str, Any] | None:
        """The JSON data in the game page (docs/pages.md); None on other pages."""
        match = re.search(r'<script type="application/json" id="data">(.*?)</script>', self.text, re.DOTALL)
        data = json.loads(match[1]) if match else None
        return data if isinstance(data, dict) else None

    @property
    def form(self) -> forms.Form | None:
        return forms.to_answer(self.text)

    @property
    def step(self) -> str:
        """The key of the step that the page shows."""
        match = re.search(r'<body[^>]*\bdata-step="([^"]*)"', self.text)
        return html.unescape(match[1]) if match else ""

    @property
    def end(self) -> str:
        """The end before the last step that the page shows; "" if it shows none."""
        match = re.search(r'<body[^>]*\bdata-end="([^"]*)"', self.text)
        return html.unescape(match[1]) if match else ""

    @property
    def least_seconds(self) -> float:
        """The seconds before which the page's answers are not taken."""
        match = re.search(r'<body[^>]*\bdata-least="([0-9.]+)"', self.text)
        return float(match[1]) if match else 0

    @property
    def is_last(self) -> bool:
        """Whether this is the study's last page."""
        return re.search(r"<body[^>]*\bdata-done\b", self.text) is not None

    @property
    def code(self) -> str | None:
        """The text of the first element of class `code`: the completion code. None if there is no such element."""
        match = re.search(r'class="code"[^>]*>([^<]+)<', self.text)
        return html.unescape(match[1]).strip() if match else None


def links(page: str) -> list[str]:
    """Return the addresses of a page's links."""
    tags = (token for token in markup.tokens(page) if token.start == "a")
    return [markup.attributes(tag.attributes).get("href", "").strip() for tag in tags]


def leads_elsewhere(address: str) -> bool:
    """Return whether an address of a link is of another site."""
    return address.lower().startswith(("https://", "http://"))
