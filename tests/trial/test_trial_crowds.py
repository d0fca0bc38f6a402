"""Many connections to one trial, slow connections, and WebSocket frames that are too large or wrong."""

import asyncio
import contextlib
import os
import socket
import ssl
import struct
from pathlib import Path

from hippodrome.trial.server.listener import MAX_UNAUTHENTICATED_WEBSOCKETS, PINGS_A_SECOND
from tests.trial.test_trial_tls import KEYS, put

SILENT = b""
SLOW = b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow: "  # the rest is never sent
UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n"
)
DEFLATE = b"Sec-WebSocket-Extensions: permessage-deflate; client_max_window_bits\r\n"


def connect(port, first=SILENT):
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    connection.sendall(first)
    return connection


def masked(opcode, payload, *, fin=True, length=None, reserved=0):
    """Return a client's frame; `length` is the length in its header, if that is to be wrong."""
    size = len(payload) if length is None else length
    head = bytes([(0x80 if fin else 0) | reserved | opcode])
    if size < 126:
        head += bytes([0x80 | size])
    elif size < 65536:
        head += bytes([0x80 | 126]) + struct.pack("!H", size)
    else:
        head += bytes([0x80 | 127]) + struct.pack("!Q", size)
    return head + b"\0\0\0\0" + payload  # a mask of zeros leaves the payload as it is


def send_frames(port, *frames, extra=b""):
    """Shake hands, send frames, and read until the server closes; return its close code, and whether it took an extension."""
    with connect(port, UPGRADE + extra + b"\r\n") as connection:
        got = b""
        while b"\r\n\r\n" not in got:
            got += connection.recv(4096)
        head, _, got = got.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 101")
        with contextlib.suppress(ConnectionError):
            for frame in frames:
                connection.sendall(frame)
            while more := connection.recv(65536):
                got += more
        at = got.rfind(b"\x88")
        return struct.unpack("!H", got[at + 2 : at + 4])[0] if at >= 0 else None, b"permessage-deflate" in head


def memory(server):
    pages = int(Path(f"/proc/{server.process.pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE")


def open_crowd(port, firsts):
    crowd = []
    for number in range(500):
        with contextlib.suppress(ConnectionError):  # the server closed it before it had sent anything
            crowd.append(connect(port, firsts[number % len(firsts)]))
    return crowd


async def connect_and_play(server, open_client):
    async with open_client(server.address) as client:
        await client.play(20)


async def test_five_hundred_strangers_do_not_keep_the_participant_out(launch, open_client):
    """Silent and slow connections, and strangers who shake hands and say nothing: all at once, while the participant plays."""
    server = launch(HELLO_SECONDS="5")
    async with open_client(server.address) as client:
        await client.play()
        before = memory(server)
        strangers = (SILENT, SLOW, UPGRADE + b"\r\n")
        arriving = asyncio.create_task(asyncio.to_thread(open_crowd, server.port, strangers))
        await client.until(arriving.done)
        await client.see(20)
        assert memory(server) - before < 100_000_000
    await connect_and_play(server, open_client)
    for stranger in arriving.result():
        read_until_closed(stranger)
    assert "Traceback" not in server.log_text()


async def test_of_strangers_who_shake_hands_the_oldest_is_closed(launch):
    server = launch()
    strangers = [connect(server.port, UPGRADE + b"\r\n") for _ in range(MAX_UNAUTHENTICATED_WEBSOCKETS + 1)]
    read_until_closed(strangers[0])
    for stranger in strangers[1:]:
        assert stranger.recv(4096).startswith(b"HTTP/1.1 101")
        stranger.close()


def read_until_closed(connection):
    connection.settimeout(60)
    with contextlib.suppress(ConnectionError):
        while connection.recv(4096):
            pass
    connection.close()


async def test_a_connection_that_says_nothing_before_tls_is_cut_off(launch, open_client, tmp_path):
    chain = put(tmp_path / "store" / "ssl", 1)
    server = launch(HELLO_SECONDS="3", **KEYS)
    crowd = [
        connect(server.port, first) for first in (SILENT, b"\x16\x03\x01", b"GET / HTTP/1.1\r\n\r\n") for _ in range(20)
    ]
    trusted = ssl.create_default_context(cadata=chain.decode())
    async with open_client(f"wss://localhost:{server.port}/", ssl=trusted) as client:
        await client.play()
    for connection in crowd:
        read_until_closed(connection)
    assert "Traceback" not in server.log_text()


async def test_giant_frames_are_refused_before_they_arrive(launch, open_client):
    """The server reads the size in the header, and keeps nothing of such a frame; in fragments they are refused, too."""
    server = launch()
    before = memory(server)
    for frames in (
        [masked(1, b"x", length=2**62)],
        [masked(1, b"x", length=4097)],
        [masked(1, b"x" * 2000, fin=False), masked(0, b"x" * 2000, fin=False), masked(0, b"x" * 2000)],
        [masked(2, b"x" * 4097)],
    ):
        assert send_frames(server.port, *frames)[0] == 1009
    assert memory(server) - before < 20_000_000
    await connect_and_play(server, open_client)
    assert "Traceback" not in server.log_text()


async def test_frames_that_break_the_protocol_close_the_connection(launch, open_client):
    server = launch()
    for frame, code in (
        (masked(9, b"x" * 200), 1002),  # a ping of more than 125 bytes
        (masked(9, b"", fin=False), 1002),
        (masked(3, b""), 1002),
        (masked(0, b"x"), 1002),
        (masked(1, b"x", reserved=0x40), 1002),
        (b"\x81\x02hi", 1002),  # not masked
        (masked(1, b"\xff\xfe"), 1007),
    ):
        assert send_frames(server.port, frame)[0] == code, frame
    await connect_and_play(server, open_client)


def test_compressed_frames_are_not_agreed_to(launch):
    """So that no small frame can unpack to a huge one."""
    server = launch()
    code, agreed = send_frames(server.port, masked(1, b"\xaa\x56\x2a\x00", reserved=0x40), extra=DEFLATE)
    assert not agreed
    assert code == 1002


async def test_a_flood_of_pings_or_tiny_fragments_ends_the_connection(launch, open_client):
    server = launch(HELLO_SECONDS="2")
    before = memory(server)
    code, _ = send_frames(
        server.port, masked(9, b"x" * 100) * 20_000, masked(1, b"", fin=False), masked(0, b"", fin=False) * 50_000
    )
    assert code in (4408, 1009, 1006, None)
    assert memory(server) - before < 50_000_000
    await connect_and_play(server, open_client)
    assert "Traceback" not in server.log_text()


async def test_a_client_that_sends_hundreds_of_pings_is_cut_off(launch):
    server = launch()
    code, _ = send_frames(server.port, masked(9, b"") * 10 * PINGS_A_SECOND)
    assert code is None


async def test_a_stranger_with_endless_headers_is_cut_off(launch, open_client):
    server = launch(HELLO_SECONDS="2")
    for endless in (b"GET / HTTP/1.1\r\n" + b"X: y\r\n" * 100_000, b"GET /" + b"a" * 1_000_000, b"\0" * 1_000_000):
        with contextlib.suppress(ConnectionError):
            connection = connect(server.port, endless)
            while connection.recv(65536):
                pass
            connection.close()
    await connect_and_play(server, open_client)
    assert "Traceback" not in server.log_text()
