"""What is answered to a request that cannot be carried out: the names and sentences of Gymie 0.5.4 where it has them.

Gymie's server closes the connection with a code and the sentence (gymie/server.py, `message_handle`): 1003 if the
message cannot be read, 1007 for all else. Its client hands that to the program as an exception.
"""

from __future__ import annotations

import os

_LONGEST = 300  # characters of a sentence


class GymError(Exception):
    """A request that cannot be carried out. `str` is a sentence for the client."""

    code = 1007
    """With which the connection of a client of Gymie's is closed."""

    def __str__(self) -> str:
        return short(super().__str__(), _LONGEST)

    @property
    def brief(self) -> str:
        """The sentence that Gymie's server has for it."""
        return str(self)


class InvalidMessage(GymError):
    """The message is no request."""

    code = 1003


class MethodNotFound(GymError):
    """There is no such method."""


class WrongParameters(GymError):
    """The parameters are not those of the method. Its arguments: a sentence, and what is wrong with them."""

    def __str__(self) -> str:
        return short(": ".join(map(str, self.args)), _LONGEST)

    @property
    def brief(self) -> str:
        return short(str(self.args[0]), _LONGEST)


class _Named(GymError):
    """An error that a program's own `get_env` may raise as in Gymie: with the environment's id, or with nothing."""

    words = "{}"

    def __str__(self) -> str:
        return short(": ".join([self._named(), *map(str, self.args[1:])]), _LONGEST)

    @property
    def brief(self) -> str:
        return self._named()

    def _named(self) -> str:
        return self.words.format(short(str(self.args[0]), 80) if self.args else "?")


class EnvironmentNotFound(_Named):
    """There is no environment of this id."""

    words = "Environment `{}` not found"


class EnvironmentMalformed(_Named):
    """The environment's id is wrong, or the environment cannot be made."""

    words = "Environment `{}` is malformed"

    @property
    def brief(self) -> str:
        """With the reason: "malformed" is also what Gymie says of an environment that lacks a package."""
        return str(self)


class InstanceNotFound(_Named):
    """This connection has no environment of this id."""

    words = "Instance `{}` not found"


class WrongAction(_Named):
    """The environment does not take this action, or raised while it took it."""

    words = "Action `{}` is wrong"


class EnvironmentFailed(GymError):
    """The environment raised."""


class TooSlow(GymError):
    """The environment did not come back in time."""


class LimitReached(GymError):
    """The request would exceed a limit of the server."""


def short(text: str, most: int) -> str:
    """At most `most` characters of `text`, in one line."""
    line = " ".join(text.split())
    return line if len(line) <= most else line[: most - 1] + "…"


def reason(text: str) -> str:
    """`text` as a close frame can hold it: 123 bytes of UTF-8 (RFC 6455, 5.5)."""
    encoded = text.encode("utf-8", "replace")
    return text if len(encoded) <= 123 else encoded[:120].decode("utf-8", "ignore") + "…"


def unusable(error: OSError | UnicodeError) -> str:
    """Why a server cannot listen at an address."""
    number = error.errno or 0 if isinstance(error, OSError) else 0
    return os.strerror(number) if number > 0 else "there is no such host"  # getaddrinfo's numbers are negative


def of(error: BaseException) -> str:
    """An exception in words: its class and its text, if that can be had."""
    try:
        said = str(error)
    except Exception:  # noqa: BLE001 - the exception is the researcher's
        said = ""
    return f"{type(error).__name__}: {said}" if said else type(error).__name__
