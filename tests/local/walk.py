"""A participant who takes part over HTTP and WebSocket, as a browser does."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import httpx
from websockets.exceptions import ConnectionClosedOK
from websockets.sync.client import ClientConnection, connect

from testing.visitors import hidden
from testing.waiting import PATIENCE


class Walker:
    """Walks through a study of `url` (`http://127.0.0.1:…`)."""

    def __init__(self, url: str, project: str, user: str) -> None:
        self.link = f"{url}/next?projectId={project}&userId={user}"
        self.user = user
        self.http = httpx.Client(timeout=20)

    def page(self) -> str:
        answer = self.http.get(self.link, headers={"accept": "text/html"})
        assert answer.status_code == 200, answer.text
        return answer.text

    def state(self) -> dict[str, Any]:
        """Return what a program is told: `page`, `state`, `url`, `token`."""
        found = self.http.get(self.link, headers={"accept": "application/json"})
        assert found.status_code == 200, found.text
        return found.json()  # type: ignore[no-any-return]

    def answer(self, **answers: str) -> None:
        """Fill in the page that is shown."""
        sent = self.http.post(self.link, data={**hidden(self.page()), **answers}, headers={"accept": "text/html"})
        assert sent.status_code == 303, sent.text

    def ask_again(self) -> None:
        """Ask for another server, after several were lost."""
        self.answer(**{"hippodrome-action": "restart"})

    def until(self, wanted: str, seconds: float = PATIENCE, *, attempt: int | None = None) -> dict[str, Any]:
        """Wait until the game's server (of this attempt, if given) is in that state."""
        until = time.monotonic() + seconds
        while (state := self.state()).get("state") != wanted or attempt not in (None, state.get("attempt")):
            assert time.monotonic() < until, state
            time.sleep(0.1)
        return state

    @contextmanager
    def connect(self, state: dict[str, Any]) -> Iterator[ClientConnection]:
        """Connect to the game. Returns the connection."""
        with connect(state["url"], close_timeout=1) as game:
            game.send(json.dumps({"userId": self.user, "token": state["token"]}))
            yield game

    def play(self, state: dict[str, Any], action: str = "left") -> dict[str, Any]:
        """Play until the trial reports its end. Returns the last message before it."""
        last: dict[str, Any] = {}
        with self.connect(state) as game:
            game.send(json.dumps({"command": "start"}))
            for text in game:
                if text == "done":
                    break
                message = json.loads(text)
                if "frame" in message:
                    with suppress(ConnectionClosedOK):  # the trial may be over before its last frames have arrived
                        game.send(json.dumps({"action": action}))
                else:
                    last = message
        return last


def at_the_game(url: str) -> Walker:
    """Return the participant P1 of the study `quick`, who has answered the page before the game."""
    walker = Walker(url, "quick", "P1")
    walker.answer(word="one")
    return walker
