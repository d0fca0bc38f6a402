"""The exception `PageError`, which ends a request with a page of a title and a text."""

from __future__ import annotations

from typing import NamedTuple

from hippodrome.control import http
from hippodrome.control.http import Request, Response
from hippodrome.control.model.texts import IN_ENGLISH, Texts
from hippodrome.control.participants import frame


class HippoAnswer(NamedTuple):
    """HIPPO's own response in the same case: its status and its text. `page` is empty if HIPPO's text is not used."""

    status: int
    page: str = ""


ACTED_ON = (200, 400)
"""The statuses on which HIPPO's front end acts: after 200 it shows the page, after 400 it asks for the project's id.
After any other status it waits without end (IRLL/HIPPO_Gym_FrontEnd_React, `src/main.js`). HIPPO responds with these
two alone (IRLL/HIPPO_Gym_AWS, `next_step.py`)."""
PROJECT_NOT_FOUND = HippoAnswer(400, "Project ID Not Found")
CONTENT_NOT_FOUND = HippoAnswer(200, "Content Not Found")
REFUSED = HippoAnswer(400)


class PageError(Exception):
    """Ends a request with a page of this title and text, or with JSON for a program.

    `status` is the HTTP status, `lang` the language of title and text. With `hippo`, programs get HIPPO's status and
    text. A front end gets status 200 instead of a status on which HIPPO's front end does not act (`ACTED_ON`).
    """

    def __init__(
        self, status: int, title: str, text: str, hippo: HippoAnswer | None = None, lang: str = IN_ENGLISH.language
    ) -> None:
        super().__init__(title)
        self.status, self.title, self.text, self.hippo, self.lang = status, title, text, hippo, lang

    @classmethod
    def of(cls, texts: Texts, status: int, name: str, hippo: HippoAnswer | None = None, **values: object) -> PageError:
        """Return the error with texts in the study's own words.

        The title is the study's text `name`. The sentence is its text `{name}Text`, filled in with `values`.
        """
        title, text = texts[name], texts.say(f"{name}Text", **values)
        return cls(status, title, text, hippo, texts.language)

    def response(self, request: Request, contact: str = "") -> Response:
        """Return the response to this request: the page, or JSON for a program.

        `contact` is the sentence that says how the researchers can be reached.
        """
        if request.wants_json:
            answer = self.hippo or HippoAnswer(self.status)
            status = answer.status if answer.status in ACTED_ON or not request.is_front_end else 200
            return program_message(status, self.title, self.text, answer.page)
        page = frame.message_page(self.title, f"{self.text} {contact}".strip(), lang=self.lang)
        return http.html(self.status, page.html, page.headers)


def program_message(status: int, title: str, text: str, page: str = "") -> Response:
    """Return a response with JSON for a program that shows pages.

    Its `page` is the one given; if that is empty, it is the title and the text as HTML.
    """
    shown = page or frame.form_message(title, text)
    return http.as_json(status, {"page": shown, "css": None, "message": f"{title}. {text}"})
