"""The errors of requests, with the names and sentences that Gymie 0.5.4 has for them.

Gymie's server closes the connection with a code and the sentence (gymie/server.py, `message_handle`): 1003 if the
message cannot be read, 1007 for every other error. Its client gives them to the program as an exception.
"""

from __future__ import annotations

import os

_LONGEST = 300  # the most characters of a sentence


class GymError(Exception):
    """A request cannot be carried out. `str` is a sentence for the client."""

    code = 1007
    """The close code for the connection of a client of Gymie's."""

    def __str__(self) -> str:
        return short(super().__str__(), _LONGEST)

    @property
    def brief(self) -> str:
        """Return Gymie's sentence for the error, without further reasons."""
        return str(self)


class InvalidMessage(GymError):
    """The message is no request."""

    code = 1003


class MethodNotFound(GymError):
    """The request names a method that does not exist."""


class WrongParameters(GymError):
    """The parameters do not fit the method. The exception's arguments are a sentence and, if known, the reason."""

    def __str__(self) -> str:
        return short(": ".join(map(str, self.args)), _LONGEST)

    @property
    def brief(self) -> str:
        return short(str(self.args[0]), _LONGEST)


class _Named(GymError):
    """An error about an id or an action, which is the exception's first argument. Further arguments are reasons.

    A program's own `get_env` may raise it as in Gymie, also without arguments.
    """

    sentence = "{}"

    def __str__(self) -> str:
        return short(": ".join([self._named(), *map(str, self.args[1:])]), _LONGEST)

    @property
    def brief(self) -> str:
        return self._named()

    def _named(self) -> str:
        return self.sentence.format(short(str(self.args[0]), 80) if self.args else "?")


class EnvironmentNotFound(_Named):
    """There is no environment of this id."""

    sentence = "Environment `{}` not found"


class EnvironmentMalformed(_Named):
    """The environment's id is wrong, or the environment cannot be made."""

    sentence = "Environment `{}` is malformed"

    @property
    def brief(self) -> str:
        """Return Gymie's sentence and the reason: Gymie calls an environment malformed also if a package is missing."""
        return str(self)


class InstanceNotFound(_Named):
    """This connection has no environment of this id."""

    sentence = "Instance `{}` not found"


class WrongAction(_Named):
    """The action does not fit the action space, or `step` of the environment raised an exception."""

    sentence = "Action `{}` is wrong"


class EnvironmentFailed(GymError):
    """The environment raised an exception, or returned something that cannot be used."""


class TooSlow(GymError):
    """The environment did not return in time."""


class LimitReached(GymError):
    """The request would exceed a limit of the server."""


def short(text: str, most: int) -> str:
    """Put the text on one line, cut to `most` characters."""
    line = " ".join(text.split())
    return line if len(line) <= most else line[: most - 1] + "…"


def reason(text: str) -> str:
    """Shorten the text to what a close frame can hold: 123 bytes of UTF-8 (RFC 6455, 5.5).

    Whole words are left out in the middle: the end of an error often says what to do.
    """
    if len(text.encode("utf-8", "replace")) <= 123:
        return text
    start = _first_words(text, 80)
    rest = 123 - len(f"{start} … ".encode())
    return f"{start} … {_first_words(text[::-1], rest)[::-1]}"


def _first_words(text: str, most: int) -> str:
    """Return the words that fit into so many bytes; if not even one does, its beginning."""
    fitting = text.encode("utf-8", "replace")[:most].decode("utf-8", "ignore")
    return fitting if text[len(fitting) :].startswith(" ") else fitting.rpartition(" ")[0] or fitting


def unusable(error: OSError | UnicodeError) -> str:
    """Return why a server cannot listen at an address."""
    number = error.errno or 0 if isinstance(error, OSError) else 0
    return os.strerror(number) if number > 0 else "there is no such host"  # getaddrinfo's numbers are negative


def described(error: BaseException) -> str:
    """Describe an exception by its class and text; by its class alone if it has no text or `str` of it raises."""
    try:
        text = str(error)
    except Exception:  # noqa: BLE001 - the exception is the researcher's
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__
