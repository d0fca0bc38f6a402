"""The environment variables that servers and `hippodrome check` take over from this process."""

from __future__ import annotations

import os

from hippodrome import places
from hippodrome.protocol import environment

_AWS = ("AWS_", "ECS_")  # a server needs no credentials, and knows nothing of a task on AWS
# Names of a server's owner. They are common: a desktop may set SESSION, and a shell GROUP, for purposes of its own.
_OWNER = (*environment.PARTICIPANT, environment.SESSION)
_NOT_INHERITED = (*_OWNER, environment.LLM_KEY)  # the key is only for servers of studies with a language model


def inherited_environment() -> dict[str, str]:
    """Return this process's variables, so that servers find Hippodrome: without _AWS and _NOT_INHERITED."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith(_AWS) and name not in _NOT_INHERITED
    }
    return places.for_child(environment)
