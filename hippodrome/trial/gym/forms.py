"""The forms of answers: as Gymie 0.5.4 sends them, as its documentation has them, Gymnasium's, and exact. Pure.

`docs/gym.md` ("Forms") describes them. Gymie's client cannot read an error: it takes every message for a result. So in
its form an error closes the connection. All other clients keep their connection.
"""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from websockets.typing import Subprotocol

SUBPROTOCOL = Subprotocol("hippodrome.gym.1")
"""The subprotocol of connections that have the form EXACT."""


@dataclass(frozen=True, slots=True)
class MessageForm:
    """The form of the messages of one connection."""

    gymie: bool = False
    """Whether `make` answers with the id alone, which is no JSON, and an error closes the connection."""
    five: bool = False
    """Whether `step` answers with Gymnasium's five values, and `reset` with observation and info."""
    exact: bool = False
    """Whether messages are bytes (`exact.py`), and `make` answers with a description of the environment."""


GYMIE = MessageForm(gymie=True)
EXACT = MessageForm(five=True, exact=True)
BY_NAME = {"gymie": GYMIE, "documented": MessageForm(), "gymnasium": MessageForm(five=True)}
"""The forms that an address may ask for."""


def form_of(address: str) -> MessageForm | None:
    """Return the form that an address asks for, by default Gymie's; None if there is no such form."""
    return BY_NAME.get(parse_qs(urlsplit(address).query).get("form", ["gymie"])[0])
