"""The exception that ends a request with a page of one sentence."""

from __future__ import annotations

from typing import NamedTuple

from hippodrome import http
from hippodrome.http import Request, Response
from hippodrome.model.texts import IN_ENGLISH, Texts
from hippodrome.participants import frame


class HippoAnswer(NamedTuple):
    """The status and the text with which HIPPO answers. Without a text, a program gets the page's own."""

    status: int
    page: str = ""


ACTED_ON = (200, 400)
"""HIPPO's front end shows the page of 200, and for 400 a page that asks for the project's id. After any other status it
waits for ever (IRLL/HIPPO_Gym_FrontEnd_React, `src/main.js`). HIPPO answers these two (IRLL/HIPPO_Gym_AWS,
`next_step.py`)."""
PROJECT_NOT_FOUND = HippoAnswer(400, "Project ID Not Found")
CONTENT_NOT_FOUND = HippoAnswer(200, "Content Not Found")
REFUSED = HippoAnswer(400)


class PageError(Exception):
    """Ends a request with a page of this title and text, or JSON for a program. `status` is the HTTP status.

    If HIPPO has an answer of its own in this case, programs get its status and its text. A front end gets 200 where it
    acts on no other status. `lang` is the language of title and text.
    """

    def __init__(
        self, status: int, title: str, text: str, hippo: HippoAnswer | None = None, lang: str = IN_ENGLISH.language
    ) -> None:
        super().__init__(title)
        self.status, self.title, self.text, self.hippo, self.lang = status, title, text, hippo, lang

    @classmethod
    def of(cls, texts: Texts, status: int, name: str, hippo: HippoAnswer | None = None, **values: object) -> PageError:
        """The error in a study's words: its text of this name is the title, its text `{name}Text` the text."""
        title, text = texts[name], texts.say(f"{name}Text", **values)
        return cls(status, title, text, hippo, texts.language)

    def response(self, request: Request) -> Response:
        """The page, or JSON for a program."""
        if request.wants_json:
            answer = self.hippo or HippoAnswer(self.status)
            status = answer.status if answer.status in ACTED_ON or not request.is_front_end else 200
            return program_message(status, self.title, self.text, answer.page)
        page = frame.message_page(self.title, self.text, lang=self.lang)
        return http.html(self.status, page.html, page.headers)


def program_message(status: int, title: str, text: str, page: str = "") -> Response:
    """JSON for a program that shows pages: `page` is the given text, or title and text as HTML for a form."""
    shown = page or frame.form_message(title, text)
    return http.as_json(status, {"page": shown, "css": None, "message": f"{title}. {text}"})
