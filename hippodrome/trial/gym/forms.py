"""The forms of answers: as Gymie 0.5.4 sends them, as its documentation has them, Gymnasium's, and exact. Pure.

`docs/gym.md` ("Forms") describes them. Gymie's client cannot read an error: it takes every message for a result. So in
its form an error closes the connection with a code and the sentence (gymie/server.py, `message_handle`): 1003 if the
message cannot be read, 1007 for every other error. Its client gives them to the program as an exception. Here the
reason follows the sentence. All other clients keep their connection.
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
    """Whether messages are bytes (`values.to_bytes`), and `make` answers with a description of the environment."""


GYMIE = MessageForm(gymie=True)
EXACT = MessageForm(five=True, exact=True)
BY_NAME = {"gymie": GYMIE, "documented": MessageForm(), "gymnasium": MessageForm(five=True)}
"""The forms that an address may ask for."""


def form_of(address: str) -> MessageForm | None:
    """Return the form that an address asks for, by default Gymie's; None if there is no such form."""
    return BY_NAME.get(parse_qs(urlsplit(address).query).get("form", ["gymie"])[0])


_LONGEST = 300  # the most characters of a sentence


class GymError(Exception):
    """A request cannot be carried out. Its arguments are a sentence for the client and, if known, the reason."""

    code = 1007
    """The close code for the connection of a client of Gymie's."""

    def __str__(self) -> str:
        return short(": ".join([self.brief, *map(str, self.args[1:])]), _LONGEST)

    @property
    def brief(self) -> str:
        """Return Gymie's sentence for the error, without the reason."""
        return short(str(self.args[0]) if self.args else type(self).__name__, _LONGEST)


class InvalidMessage(GymError):
    """The message is no request."""

    code = 1003


class MethodNotFound(GymError):
    """The request names a method that does not exist."""


class WrongParameters(GymError):
    """The parameters do not fit the method."""


class _Named(GymError):
    """An error about an id or an action, which is the first argument. A program's `get_env` may raise it without."""

    sentence = "{}"

    @property
    def brief(self) -> str:
        return self.sentence.format(short(str(self.args[0]), 80) if self.args else "?")


class EnvironmentNotFound(_Named):
    """There is no environment of this id."""

    sentence = "Environment `{}` not found"


class EnvironmentMalformed(_Named):
    """The environment's id is wrong, or the environment cannot be made."""

    sentence = "Environment `{}` is malformed"


class InstanceNotFound(_Named):
    """This connection has no environment of this id."""

    sentence = "Instance `{}` not found"


class WrongAction(_Named):
    """The action does not fit the action space, or `step` of the environment raised an exception."""

    sentence = "Action `{}` is wrong"


class EnvironmentFailed(GymError):
    """The environment raised an exception, or returned something that cannot be used."""


class LimitReached(GymError):
    """The request would exceed a limit of the server."""


def short(text: str, most: int) -> str:
    """Put the text on one line, cut to `most` characters."""
    line = " ".join(text.split())
    return line if len(line) <= most else line[: most - 1] + "…"


def described(error: BaseException) -> str:
    """Describe an exception by its class and text; by its class alone if it has no text or `str` of it raises."""
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 - the exception is the researcher's
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
