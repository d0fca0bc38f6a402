"""Plays on a connection to a trial server (docs/wire.md): presses keys at random, talks, and acknowledges frames."""

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

from hippodrome.bots.report import BotReport, PlayedStep
from hippodrome.bots.talk import ScriptedTalk
from hippodrome.protocol import keyboard
from hippodrome.trial.core.choices import NOT_POSSIBLE
from hippodrome.trial.pictures.frames import Decoder
from hippodrome.trial.pictures.scene_encoder import ASSET, PACKED_SCENE, SCENE, SceneDecoder

_ASSET, _SCENES = bytes([ASSET]), (bytes([SCENE]), bytes([PACKED_SCENE]))

MAX_TURN_SECONDS = 600.0  # the longest turn of another player: the largest `policySeconds`
QUIET_SECONDS = 20.0  # if no message comes for so long while a game is played, the bot gives the game up as lost


class RandomKeys:
    """Presses keys at random: it holds some keys down, and presses others once."""

    def __init__(self, random: Random, controls: dict[str, Any]) -> None:
        self._random = random
        shown: Sequence[str] = controls.get("UI", ())
        self._keys = [key for key in ("left", "right", "up", "down", "fire") if key in shown]
        self._actions = [name for name in controls.get("actionSpace", ()) if name != "noop" and _offered(name, shown)]
        key_map: Mapping[str, str] = controls.get("keys", {})
        self._mapped_keys = list(dict.fromkeys(key for combined in key_map for key in keyboard.parts(combined)))
        self._words = [*(word for word in ("good", "bad") if word in shown), *controls.get("words", ())]
        self._held: list[str] = []

    def move(self) -> list[dict[str, Any]]:
        """Return the next messages to the server: some release keys, others press keys or take an action, and a few are
        words of feedback.
        """
        random = self._random
        field, keys = ("key", self._mapped_keys) if self._mapped_keys else ("action", self._keys)
        messages: list[dict[str, Any]] = [{field: key, "held": False} for key in self._held]
        self._held = []
        if keys and random.random() < 0.7:
            self._held = random.sample(keys, min(len(keys), random.choice((1, 1, 1, 2))))
            messages += [{field: key, "held": True} for key in self._held]
        elif self._actions:
            messages.append({"action": random.choice(self._actions)})
        if self._words and random.random() < 0.1:
            messages.append({"command": random.choice(self._words)})
        return messages


def _offered(action: str, shown: Sequence[str]) -> bool:
    """Whether the page offers this action. It offers directions by the keys that it shows, and every other action."""
    if re.fullmatch("(up|down|left|right|fire)+", action) is None:
        return True
    return all(key in shown for key in re.findall("up|down|left|right", action))


class GameConnection:
    """Plays on one connection to a trial server. What the server sends is counted in `play` and `report`.

    After `seconds` of play it stops the game, if the game's controls have "stop"; with 0 it plays to the end.
    """

    def __init__(
        self, websocket: ClientConnection, play: PlayedStep, report: BotReport, random: Random, seconds: float
    ) -> None:
        self._websocket = websocket
        self._play = play
        self._report = report
        self._random = random
        self._seconds = seconds
        self._screen = Decoder()
        self._scene = SceneDecoder()
        self._images: set[str] = set()  # hashes of the images that the bot has asked for
        self._keys: RandomKeys | None = None  # None until the server has sent the controls
        self._talk: ScriptedTalk | None = None  # None if nobody talks
        self._state = ""
        self._turns = False  # whether the game is played turn by turn
        self._to_act = True  # whether it is this player's turn
        self._first = True  # whether no frame has come yet
        self._last_frame: float | None = None  # time.monotonic() of the last frame while playing
        self._may_stop = False
        self._break_seconds = 0.0  # seconds of breaks that the server has announced: nothing is played then

    async def run(self, hello: dict[str, Any]) -> None:
        """Play until the server closes.

        Raises ConnectionClosed then, TimeoutError after QUIET_SECONDS without a message, and FrameError for a frame
        that cannot be decoded.
        """
        await self._send(hello)
        pressing: asyncio.Task[None] | None = None
        try:
            while True:
                waits = MAX_TURN_SECONDS if self._turns and not self._to_act else self._break_seconds
                async with asyncio.timeout(QUIET_SECONDS + waits):
                    data = await self._websocket.recv()
                if isinstance(data, bytes):
                    await self._receive_frame(data)
                else:
                    await self._receive_message(json.loads(data))
                if self._keys is not None and pressing is None:
                    pressing = asyncio.create_task(self._press(self._keys))
        finally:
            if pressing is not None:
                pressing.cancel()
                await asyncio.wait({pressing})

    async def _send(self, message: dict[str, Any]) -> None:
        with contextlib.suppress(ConnectionClosed):  # messages that came before the end are still to be read
            await self._websocket.send(json.dumps(message))

    async def _load(self, images: Sequence[dict[str, Any]]) -> None:
        """Ask for the images of a game that is drawn by objects, as the page does."""
        for image in images:
            if image["hash"] not in self._images:
                self._images.add(image["hash"])
                await self._send({"asset": image["name"]})

    async def _receive_frame(self, data: bytes) -> None:
        """Acknowledge a frame or a scene, and count it."""
        if data[:1] == _ASSET:
            self._play.bytes += len(data)
            return
        if data[:1] in _SCENES:
            frame_id = self._scene.decode(data)
        else:
            frame_id, _ = self._screen.decode(data)
        await self._send({"ack": frame_id})
        play, now = self._play, time.monotonic()
        play.bytes += len(data)
        if not self._first:  # an earlier connection may have shown the first frame, too
            play.frames += 1
        self._first = False
        if self._state == "playing" and not self._turns:  # a game that is played turn by turn has no frame rate
            if self._last_frame is not None:
                play.timed_frames += 1
                play.seconds += now - self._last_frame
            self._last_frame = now
        else:
            self._last_frame = None

    async def _receive_message(self, message: dict[str, Any]) -> None:
        """Note what the server says of the game, and press the button that begins it or goes on."""
        play = self._play
        if message.get("error", NOT_POSSIBLE) != NOT_POSSIBLE:  # random keys cause NOT_POSSIBLE
            trouble = f"the game says: {message['error']}"
            if not message.get("done") or trouble not in self._report.troubles:  # the last message may say it again
                self._report.troubles.append(trouble)
        if "UI" in message:
            self._turns = message.get("pace") == "turns"
            self._keys = RandomKeys(self._random, message)
            if "chat" in message and self._talk is None:
                self._talk = ScriptedTalk(self._random, message["chat"], time.monotonic())
            await self._load(message.get("assets", ()))
            self._may_stop = "stop" in message["UI"]
        if self._talk is not None and "lines" in message:
            play.lines += self._talk.heard(message)
        elif self._talk is not None and "refused" in message:
            self._talk.refused()
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
            if self._presses_start(message):
                await self._send({"command": "start"})

    def _presses_start(self, message: dict[str, Any]) -> bool:
        """Whether the bot presses the button that begins the game or goes on."""
        if self._state == "break":
            by_itself = "nextIn" in message  # otherwise the break shows a page with a button
            # If the break ends without the button, every second bot waits for that.
            if not by_itself or self._random.random() < 0.5:
                return True
        if "people" not in message:
            return self._state in ("ready", "paused")
        waits = "beginsIn" in message or "heldFor" in message  # the game waits for others, and no command ends that
        reads = message["people"].get(message.get("you")) == "reads"
        return reads or (self._state == "paused" and not waits)

    async def _press(self, keys: RandomKeys) -> None:
        """Press keys while the game is played, and talk; stop the game when it was played for long enough."""
        began: float | None = None
        while True:
            await asyncio.sleep(self._random.uniform(0.1, 0.5))
            for message in self._talk.messages(time.monotonic()) if self._talk is not None else ():
                await self._send(message)
            if self._state != "playing" or not self._to_act:
                continue
            began = began or time.monotonic()
            played = time.monotonic() - began if self._turns else self._play.seconds
            if self._seconds and played >= self._seconds and self._may_stop:
                self._play.stopped = True
                await self._send({"command": "stop"})
                return
            for message in keys.move():
                await self._send(message)
