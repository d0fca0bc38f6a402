"""The simplest server that answers requests over a WebSocket, as a yardstick: `python -m bench.echo REPLY BYTES`.

It is the server of the package `websockets` as its documentation shows it, without code of Hippodrome. It answers each
text with REPLY, and each binary message with BYTES bytes. It prints its port, and runs until it is killed.
"""

from __future__ import annotations

import asyncio
import sys

from websockets.asyncio.server import ServerConnection, serve


async def run(reply: str, binary: bytes) -> None:
    async def answer(websocket: ServerConnection) -> None:
        async for message in websocket:
            await websocket.send(reply if isinstance(message, str) else binary)

    # No pings: the measuring client takes every message for an answer.
    async with serve(answer, "127.0.0.1", 0, compression=None, ping_interval=None) as server:
        print(server.sockets[0].getsockname()[1], flush=True)
        await asyncio.get_running_loop().create_future()


if __name__ == "__main__":
    asyncio.run(run(sys.argv[1], bytes(int(sys.argv[2]))))
