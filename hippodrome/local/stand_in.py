"""Decides whether a study on this machine asks its language model, or a stand-in that costs nothing."""

from __future__ import annotations

import os
from collections.abc import Callable, MutableMapping

from hippodrome.console.problem import Exit, Problem
from hippodrome.control.config import Config
from hippodrome.local.fake_model import FakeModel
from hippodrome.protocol import environment
from hippodrome.protocol.loopback import is_loopback

_NO_KEY = "LLM_KEY is not set, so a stand-in answers in the place of the language model: it repeats what it reads"


class StandIn:
    """The stand-in of a study, which is started when the study needs it. Its servers inherit where it is."""

    def __init__(self, *, always: bool, env: MutableMapping[str, str] = os.environ) -> None:
        """`always`: the stand-in answers also if there is a key."""
        self._always = always
        self._env = env
        self._model: FakeModel | None = None

    def use(self, config: Config, say: Callable[[str], None] = lambda sentence: None) -> None:
        """Start the stand-in if the study has a model that cannot be asked; `say` gets a sentence then.

        Raises `Problem` if FAKE_MODEL is wrong.
        """
        unpaid = not self._env.get(environment.LLM_KEY) and not all(
            is_loopback(model["url"]) for model in config.models
        )
        if self._model is not None or not config.models or not (self._always or unpaid):
            return
        try:
            self._model = FakeModel()
        except ValueError as error:
            raise Problem(f"{error}.", exit_code=Exit.MISUSE) from None
        self._env[environment.LLM_URL] = self._model.url
        self._env.pop(environment.LLM_KEY, None)
        if not self._always:
            say(_NO_KEY)

    def close(self) -> None:
        """End the stand-in, if it runs."""
        if self._model is not None:
            self._env.pop(environment.LLM_URL, None)
            self._model.stop()
            self._model = None
