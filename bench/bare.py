"""The simplest server that answers a key with a picture, as a yardstick: `python -m bench.bare RATE FRAME [FRAME ...]`.

A WebSocket server sends one of its ready-made JPEG files at each tick; PAGE is the page for it, which decodes them with
the browser's own decoder. There is no game, recording, encoding or flow control, and no code of Hippodrome. The server
sends the first half of the files while no key is down, and the other half while a key is.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys
from pathlib import Path

from websockets.asyncio.server import ServerConnection, serve
from websockets.exceptions import ConnectionClosed

SECONDS = 300.0  # the server ends by itself after so long
PAGE = """<!doctype html><title>Bare</title><canvas id=screen></canvas><button id=overlay-button>Start</button><script>
const canvas = document.getElementById("screen"), context = canvas.getContext("2d", { alpha: false });
document.getElementById("overlay-button").onclick = () => {
  const socket = new WebSocket("%s");
  socket.binaryType = "arraybuffer";
  let drawn = Promise.resolve();
  socket.onmessage = ({ data }) => {
    const decoding = createImageBitmap(new Blob([data], { type: "image/jpeg" }));
    drawn = drawn.then(async () => {
      const picture = await decoding;
      if (canvas.width !== picture.width) Object.assign(canvas, { width: picture.width, height: picture.height });
      context.drawImage(picture, 0, 0);
      picture.close();
    });
  };
  addEventListener("keydown", (event) => event.repeat || socket.send("1"));
  addEventListener("keyup", () => socket.send("0"));
};
</script>"""


async def run(rate: int, pictures: list[bytes]) -> None:
    async def talk(websocket: ServerConnection) -> None:
        half, down = len(pictures) // 2, False

        async def listen() -> None:
            nonlocal down
            async for said in websocket:
                down = said == "1"

        listening = asyncio.create_task(listen())
        loop = asyncio.get_running_loop()
        begun, tick = loop.time(), 0
        with contextlib.suppress(ConnectionClosed):
            while True:
                tick = max(tick + 1, int((loop.time() - begun) * rate))
                await asyncio.sleep(begun + tick / rate - loop.time())
                await websocket.send(pictures[half * down + tick % half])
        listening.cancel()

    async with serve(talk, "127.0.0.1", 0, compression=None) as server:
        print(server.sockets[0].getsockname()[1], flush=True)
        await asyncio.sleep(SECONDS)


if __name__ == "__main__":
    asyncio.run(run(int(sys.argv[1]), [Path(name).read_bytes() for name in sys.argv[2:]]))
