"""HIPPO's React front end as a trial server sees it: its messages, word for word, and how its page reads the answers.

Source: its src/components/Game/game.js (2022-04) and src/utils/getKeyInput.js.
"""

from __future__ import annotations

import contextlib
import json
import ssl
import uuid
from collections.abc import AsyncIterator
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from tests.trial.client_messages import TakesMessages

KEYS = {"ArrowLeft": ("leftArrow", "left"), "ArrowRight": ("rightArrow", "right"), "KeyQ": ("leftUp", "leftUp")}


class HippoPage(TakesMessages):
    """The page's state, and the messages that its buttons and keys send."""

    def __init__(self, websocket: ClientConnection, user_id: str, project_id: str) -> None:
        self.websocket = websocket
        self.user_id = user_id
        self.project_id = project_id
        self.ui: list[str] = []
        self.instructions: list[str] = []
        self.frame_count = 0
        self.frame_id = 0
        self.held: str | None = None
        self.ended = False
        """Its window "The game has ended" is open."""
        self.said: list[dict[str, Any]] = []

    async def send(self, **data: Any) -> None:
        """Send as its sendMessage does."""
        data |= {"frameCount": self.frame_count, "frameId": self.frame_id}
        await self.websocket.send(json.dumps(data))

    async def hello(self) -> None:
        await self.send(userId=self.user_id, projectId=self.project_id)

    async def command(self, name: str) -> None:
        """A click on one of HIPPO's buttons, or of the project's own."""
        browser = {"system": "Linux", "systemVersion": "", "browser": "Chrome", "browserVersion": "141"}
        await self.send(command=name, **(browser if name == "start" else {}))

    async def key_down(self, code: str, key: str) -> None:
        kind, action = KEYS.get(code, ("null", "null"))
        if action in self.ui and self.held != kind:
            self.held = kind
            await self.send(actionType=kind, action=action)
        await self.send(KeyboardEvent={"KEYDOWN": [key, ord(key[0])]})

    async def key_up(self, code: str, key: str) -> None:
        kind, action = KEYS.get(code, ("null", "null"))
        if action in self.ui:
            self.held = None if self.held == kind else self.held
            await self.send(actionType=kind, action="noop")
        await self.send(KeyboardEvent={"KEYUP": [key]})

    async def button(self, action: str) -> None:
        await self.send(actionType="mousedown", action=action)

    async def frame_rate(self, typed: str) -> None:
        """Enter in the field of the frame rate."""
        await self.send(changeFrameRate=typed)

    async def mouse(self) -> None:
        place = {"x": 12, "y": 40, "xRel": 0.02, "yRel": 0.07}
        moved = {"xMovement": 3, "yMovement": 0, "xRelMovement": 0.004, "yRelMovement": 0}
        await self.send(info="mouse move", pos=place, rel=moved, buttons=[0, 0, 0], button=0)

    async def take(self) -> None:
        """Receive one message, as its onmessage reads it."""
        data = await self.websocket.recv()
        assert isinstance(data, str), "its page knows text alone"
        if data == "done":
            self.ended = True
            return
        message = json.loads(data)
        self.said.append(message)
        self.ui = message.get("UI") or self.ui
        self.instructions = message.get("Instructions") or self.instructions
        if message.get("frame") and message.get("frameId"):
            self.frame_count += 1
            self.frame_id = message["frameId"]

    async def wait_until_heard(self) -> None:
        """Return when the server has read all messages so far. The picture after the next one shows a later step."""
        self.ui = []
        await self.command("requestUI")
        await self.until(lambda: self.ui)

    async def frames(self, more: int) -> None:
        until = self.frame_count + more
        await self.until(lambda: self.frame_count >= until)

    async def closed(self, seconds: float = 60) -> int | None:
        """Take messages until the connection is closed, which also opens the window; return the code."""
        code = await super().closed(seconds)
        self.ended = True
        return code

    @property
    def errors(self) -> list[str]:
        return [message["error"] for message in self.said if "error" in message]

    @property
    def state(self) -> str:
        return [message["state"] for message in self.said if "state" in message][-1]


@contextlib.asynccontextmanager
async def hippo_page(
    address: str,
    user_id: str = "P1",
    origin: str | None = "https://play.example.org",
    *,
    trusted: ssl.SSLContext | None = None,
    headers: dict[str, str] | None = None,
    greets: bool = True,
    host: str | None = None,
    project_id: str = "study",
) -> AsyncIterator[HippoPage]:
    """Open the page at a server's address. It sends its hello as soon as it is connected."""
    place = {"host": host} if host else {}
    async with connect(
        address,
        origin=origin,  # type: ignore[arg-type]
        compression=None,
        max_size=None,
        proxy=None,
        ssl=trusted,
        additional_headers=headers,
        **place,
    ) as websocket:
        page = HippoPage(websocket, user_id, project_id)
        if greets:
            await page.hello()
        yield page


def new_user_id() -> str:
    """Return a user id, as its constants.js makes one at each load of the page."""
    return str(uuid.uuid4())
