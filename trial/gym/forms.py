"""How a connection is answered: as Gymie 0.5.4 really does, as its documentation says, or in Gymnasium's form. Pure.

| form | chosen by | `make` | `step` | an error |
|---|---|---|---|---|
| gymie | nothing | the bare id | four values | closes the connection, with Gymie's code and sentence |
| documented | `/gym?form=documented` | `{"instance_id"}` | four values | `{"error": {"type", "message"}}` |
| gymnasium | `/gym?form=gymnasium` | `{"instance_id"}` | five values | the same |
| arrays | subprotocol `hippodrome.gym.1` | an object with the spaces | five values, or arrays | the same |

Gymie's client cannot read an error: whatever comes is its result. So an error closes the connection of such a
client; all others keep theirs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from trial.gym import values
from trial.gym.errors import GymError


@dataclass(frozen=True, slots=True)
class MessageForm:
    """How results and errors become messages."""

    name: str
    five: bool
    """`step` answers Gymnasium's five values, and `reset` observation and info."""
    bare_id: bool = False
    """`make` answers the id alone, which is no JSON."""
    closes: bool = False
    """An error closes the connection."""
    arrays: bool = False
    """`make` describes the environment, and binary messages are read."""

    def result(self, result: Any) -> str:
        """The message for a result."""
        return values.to_text(result)

    def error(self, error: GymError) -> str:
        """The message for an error."""
        return values.to_text({"error": {"type": type(error).__name__, "message": str(error)}})


GYMIE = MessageForm("gymie", five=False, bare_id=True, closes=True)
DOCUMENTED = MessageForm("documented", five=False)
GYMNASIUM = MessageForm("gymnasium", five=True)
ARRAYS = MessageForm("arrays", five=True, arrays=True)

NAMES = {form.name: form for form in (GYMIE, DOCUMENTED, GYMNASIUM)}
