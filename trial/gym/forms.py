"""The forms of answers: those of Gymie 0.5.4, those of its documentation, Gymnasium's, and raw arrays. Pure.

| form | chosen by | `make` | `step` | an error |
|---|---|---|---|---|
| gymie | nothing | the bare id | four values | closes the connection, with Gymie's code and sentence |
| documented | `/gym?form=documented` | `{"instance_id"}` | four values | `{"error": {"type", "message"}}` |
| gymnasium | `/gym?form=gymnasium` | `{"instance_id"}` | five values | the same |
| arrays | subprotocol `hippodrome.gym.1` | an object with the spaces | five values, or arrays | the same |

Gymie's client cannot read an error: it takes every message for a result. So an error closes the connection of such a
client. All other clients keep their connection.
"""

from __future__ import annotations

from dataclasses import dataclass

from trial.gym import values
from trial.gym.errors import GymError


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


def error_message(error: GymError) -> str:
    """Build the message for an error, in all forms except Gymie's."""
    return values.to_text({"error": {"type": type(error).__name__, "message": str(error)}})


GYMIE = MessageForm("gymie", five=False, bare_id=True, closes=True)
DOCUMENTED = MessageForm("documented", five=False)
GYMNASIUM = MessageForm("gymnasium", five=True)
ARRAYS = MessageForm("arrays", five=True, arrays=True)

NAMES = {form.name: form for form in (GYMIE, DOCUMENTED, GYMNASIUM)}
