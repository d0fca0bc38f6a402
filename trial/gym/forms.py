"""The forms of answers: as Gymie 0.5.4 sends them, as its documentation has them, Gymnasium's, and arrays. Pure.

| form | chosen by | `make` | `step` | an error |
|---|---|---|---|---|
| gymie | nothing | the bare id | four values | closes the connection, with Gymie's code and sentence |
| documented | `/gym?form=documented` | `{"instance_id"}` | four values | `{"error": {"type", "message"}}` |
| gymnasium | `/gym?form=gymnasium` | `{"instance_id"}` | five values | the same |
| arrays | subprotocol `hippodrome.gym.1` | an object with the spaces | five values, or arrays | the same |

Gymie's client cannot read an error: it takes every message for a result. So in its form an error closes the
connection. All other clients keep their connection.
"""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import parse_qs, urlsplit

from websockets.typing import Subprotocol

SUBPROTOCOL = Subprotocol("hippodrome.gym.1")
"""The subprotocol of connections that have the form ARRAYS."""


@dataclass(frozen=True, slots=True)
class MessageForm:
    """The form of the answers to one connection."""

    name: str
    five: bool
    """Whether `step` answers with Gymnasium's five values, and `reset` with observation and info."""
    bare_id: bool = False
    """Whether `make` answers with the id alone, which is no JSON."""
    closes: bool = False
    """Whether an error closes the connection."""
    arrays: bool = False
    """Whether `make` answers with a description of the environment, and binary messages are read."""


GYMIE = MessageForm("gymie", five=False, bare_id=True, closes=True)
DOCUMENTED = MessageForm("documented", five=False)
GYMNASIUM = MessageForm("gymnasium", five=True)
ARRAYS = MessageForm("arrays", five=True, arrays=True)

BY_NAME = {form.name: form for form in (GYMIE, DOCUMENTED, GYMNASIUM)}
"""The forms that an address may ask for."""

UNKNOWN_FORM = f"form must be one of {', '.join(BY_NAME)}.\n"
"""The HTTP answer to a handshake that asks for another form."""


def form_of(address: str) -> MessageForm | None:
    """Return the form that an address asks for, by default Gymie's; None if there is no such form."""
    return BY_NAME.get(parse_qs(urlsplit(address).query).get("form", [GYMIE.name])[0])
