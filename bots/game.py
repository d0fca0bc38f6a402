"""Plays on a connection to a trial server (docs/wire.md): presses keys at random and acknowledges frames."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import time
from collections.abc import Mapping, Sequence
from random import Random
from typing import Any

from websockets.asyncio.client import ClientConnection
from websockets.exceptions import ConnectionClosed

from bots.account import BotReport, PlayedStep
from protocol import keyboard
from trial.core.choices import NOT_POSSIBLE
from trial.pictures.frames import Decoder
from trial.pictures.scene_encoder import ASSET, PACKED_SCENE, SCENE, SceneDecoder

_ASSET, _SCENES = bytes([ASSET]), (bytes([SCENE]), bytes([PACKED_SCENE]))

MOST_THINKING = 600.0  # seconds that another player's turn may take (policySeconds)
QUIET_SECONDS = 20.0  # a playing game that shows nothing for so long is taken for lost


class Hands:
    """Presses keys at random: some are held, some are single presses."""

    def __init__(self, random: Random, controls: dict[str, Any]) -> None:
        self._random = random
        shown: Sequence[str] = controls.get("UI", ())
        self._keys = [key for key in ("left", "right", "up", "down", "fire") if key in shown]
        self._actions = [name for name in controls.get("actionSpace", ()) if name != "noop" and _offered(name, shown)]
        own: Mapping[str, str] = controls.get("keys", {})
        self._pressed = list(dict.fromkeys(key for combined in own for key in keyboard.parts(combined)))
        self._words = [*(word for word in ("good", "bad") if word in shown), *controls.get("words", ())]
        self._held: list[str] = []

    def move(self) -> list[dict[str, Any]]:
        """The next messages."""
        random = self._random
        field, keys = ("key", self._pressed) if self._pressed else ("action", self._keys)
        said: list[dict[str, Any]] = [{field: key, "held": False} for key in self._held]
        self._held = []
        if keys and random.random() < 0.7:
            self._held = random.sample(keys, min(len(keys), random.choice((1, 1, 1, 2))))
            said += [{field: key, "held": True} for key in self._held]
        elif self._actions:
            said.append({"action": random.choice(self._actions)})
        if self._words and random.random() < 0.1:
            said.append({"command": random.choice(self._words)})
        return said


def _offered(action: str, shown: Sequence[str]) -> bool:
    """Whether the page has the keys that make this action; those that are no directions it always has."""
    if re.fullmatch("(up|down|left|right|fire)+", action) is None:
        return True
    return all(key in shown for key in re.findall("up|down|left|right", action))


class GameConnection:
    """One connection to a trial server. It plays for `seconds` where the game may be stopped; 0: to the end."""

    def __init__(
        self, websocket: ClientConnection, play: PlayedStep, account: BotReport, random: Random, seconds: float
    ) -> None:
        self._websocket = websocket
        self._play = play
        self._account = account
        self._random = random
        self._seconds = seconds
        self._screen = Decoder()
        self._scene = SceneDecoder()
        self._images: set[str] = set()  # hashes of those that were asked for
        self._hands: Hands | None = None
        self._state = ""
        self._turns = False
        self._to_act = True
        self._first = True
        self._last_frame: float | None = None
        self._may_stop = False
        self._break_seconds = 0.0

    async def run(self, hello: dict[str, Any]) -> None:
        """Play until the server closes. Raises ConnectionClosed, TimeoutError, Failed."""
        await self._say(hello)
        moving: asyncio.Task[None] | None = None
        try:
            while True:
                waits = MOST_THINKING if self._turns and not self._to_act else self._break_seconds
                async with asyncio.timeout(QUIET_SECONDS + waits):
                    data = await self._websocket.recv()
                if isinstance(data, bytes):
                    await self._frame(data)
                else:
                    await self._told(json.loads(data))
                if self._hands is not None and moving is None:
                    moving = asyncio.create_task(self._move(self._hands))
        finally:
            if moving is not None:
                moving.cancel()
                await asyncio.wait({moving})

    async def _say(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(ConnectionClosed):  # what came before the end is still to be heard
            await self._websocket.send(json.dumps(message))

    async def _load(self, images: Sequence[dict[str, Any]]) -> None:
        """Ask for the images of a game that is drawn by objects, as the page does."""
        for image in images:
            if image["hash"] not in self._images:
                self._images.add(image["hash"])
                await self._say({"asset": image["name"]})

    async def _frame(self, data: bytes) -> None:
        if data[:1] == _ASSET:
            self._play.bytes += len(data)
            return
        if data[:1] in _SCENES:
            frame_id = self._scene.decode(data)
        else:
            frame_id, _ = self._screen.decode(data)
        await self._say({"ack": frame_id})
        play, now = self._play, time.monotonic()
        play.bytes += len(data)
        if not self._first:  # the first picture may be one that an earlier connection has shown
            play.frames += 1
        self._first = False
        if self._state == "playing" and not self._turns:  # turn by turn there is no rate at which pictures come
            if self._last_frame is not None:
                play.seen += 1
                play.seconds += now - self._last_frame
            self._last_frame = now
        else:
            self._last_frame = None

    async def _told(self, message: dict[str, Any]) -> None:
        play = self._play
        if message.get("error", NOT_POSSIBLE) != NOT_POSSIBLE:  # a bot that presses keys at random hears that one
            self._account.troubles.append(f"the game says: {message['error']}")
        if "UI" in message:
            self._turns = message.get("pace") == "turns"
            self._hands = Hands(self._random, message)
            await self._load(message.get("assets", ()))
            self._may_stop = "stop" in message["UI"]
        if message.get("done"):
            play.done, play.score, play.episodes = True, message.get("score", 0), message.get("episodes", 0)
            play.outcome = message.get("outcome", play.outcome)
        if "state" in message:
            self._state, play.score = message["state"], message.get("score", 0)
            self._to_act = message.get("toAct", True)
            play.frame_rate = message.get("frameRate", play.frame_rate)
            self._break_seconds = sum(message.get(name, 0.0) for name in ("nextIn", "startsIn", "beginsIn", "heldFor"))
            if self._state in ("ready", "paused", "break"):
                self._last_frame = None
            if self._goes_on(message):
                await self._say({"command": "start"})

    def _goes_on(self, message: dict[str, Any]) -> bool:
        """Whether the bot presses the button with which the game begins or goes on."""
        if self._state == "break":
            by_itself = "nextIn" in message  # otherwise there is a page to read, and a button after it
            # Of those who are offered a break that ends by itself, every second one waits for its end.
            if not by_itself or self._random.random() < 0.5:
                return True
        if "people" not in message:
            return self._state in ("ready", "paused")
        waits = "beginsIn" in message or "heldFor" in message  # for others, which no command ends
        reads = message["people"].get(message.get("you")) == "reads"
        return reads or (self._state == "paused" and not waits)

    async def _move(self, hands: Hands) -> None:
        began: float | None = None
        while True:
            await asyncio.sleep(self._random.uniform(0.1, 0.5))
            if self._state != "playing" or not self._to_act:
                continue
            began = began or time.monotonic()
            played = time.monotonic() - began if self._turns else self._play.seconds
            if self._seconds and played >= self._seconds and self._may_stop:
                await self._say({"command": "stop"})
                return
            for message in hands.move():
                await self._say(message)
