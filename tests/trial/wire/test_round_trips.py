"""Round trips are measured by the WebSocket's own pings, which any client answers without its page."""

import contextlib
import time

import pytest
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, serve
from websockets.frames import Opcode

from hippodrome.trial.wire import connection
from testing.waiting import until_async
from tests.trial.far_away import far_away


class Pinged(ServerConnection):
    """Counts pings that wait for their pong."""

    most = 0

    async def ping(self, data=None):
        answer = await super().ping(data)
        self.most = max(self.most, len(self.pending_pings))
        return answer


@contextlib.asynccontextmanager
async def measured_connection(samples, *, delay=None):
    """A connection that is measured; yields the client, the server's end, and the times and seconds that it reports."""
    reports, ends = [], []

    async def handle(websocket):
        ends.append(websocket)
        await connection.measure_round_trips(
            websocket, samples, lambda seconds: reports.append((time.monotonic(), seconds))
        )

    async with (
        serve(handle, "127.0.0.1", 0, create_connection=Pinged, compression=None, ping_interval=None) as server,
        contextlib.AsyncExitStack() as stack,
    ):
        port = server.sockets[0].getsockname()[1]
        if delay is not None:
            port = await stack.enter_async_context(far_away(port, delay))
        async with connect(f"ws://127.0.0.1:{port}", proxy=None, ping_interval=None, compression=None) as client:
            yield client, (await until_async(lambda: ends))[0], reports


async def test_a_round_trip_is_the_time_there_and_back():
    async with measured_connection(3, delay=0.1) as (_, _, reports):
        await until_async(lambda: len(reports) == 3)
    assert all(seconds >= 0.2 for _, seconds in reports)
    assert min(seconds for _, seconds in reports) < 2


async def test_the_samples_are_taken_at_once_and_later_ones_now_and_then(monkeypatch):
    monkeypatch.setattr(connection, "PING_SECONDS", 3.0)
    async with measured_connection(4) as (_, end, reports):
        await until_async(lambda: len(reports) == 5)
        assert end.most == 1
    times = [when for when, _ in reports]
    assert times[3] - times[0] < 2.9, "four samples"
    assert times[4] - times[3] >= 2.9


async def test_a_client_that_does_not_answer_is_reported_as_slow_and_gets_no_further_ping_meanwhile(monkeypatch):
    monkeypatch.setattr(connection, "MAX_ROUND_TRIP", 0.3)
    monkeypatch.setattr(connection, "PING_SECONDS", 0.1)
    async with measured_connection(1) as (client, end, reports):
        await until_async(lambda: len(reports) >= 1)
        client.transport.pause_reading()
        await until_async(lambda: [seconds for _, seconds in reports].count(0.3) == 3)
        assert len(end.pending_pings) == 1
        known = len(reports)
        client.transport.resume_reading()
        await until_async(lambda: len(reports) > known)
        assert all(seconds < 0.3 for _, seconds in reports[known:]), "the ping that was late counts once"
        assert end.most == 1


async def test_a_pong_that_answers_no_ping_is_not_counted(monkeypatch):
    """A client that sends pongs ahead does not know the four bytes of the ping that they must repeat."""
    monkeypatch.setattr(connection, "PING_SECONDS", 0.3)
    async with measured_connection(1, delay=0.1) as (client, _, reports):
        for _ in range(200):
            await client.pong(b"1234")
        await until_async(lambda: len(reports) == 3)
    assert all(seconds >= 0.2 for _, seconds in reports)


@pytest.mark.parametrize("answers", [True, False])
async def test_measuring_ends_with_the_connection(answers):
    async with measured_connection(1) as (client, _, reports):
        await until_async(lambda: reports)
        if not answers:
            client.transport.pause_reading()
        client.transport.abort()
        known = len(reports)
    assert len(reports) - known <= 1


def test_the_seconds_of_pings_are_those_of_the_documents():
    assert (connection.MAX_ROUND_TRIP, connection.PING_SECONDS) == (10, 5)


def test_a_ping_costs_sixteen_bytes():
    """As connection.py says: a ping with 4 bytes of its own, and its pong, which a client masks."""
    from websockets.frames import Frame

    ping, pong = (Frame(opcode, b"1234") for opcode in (Opcode.PING, Opcode.PONG))
    assert (len(ping.serialize(mask=False)), len(pong.serialize(mask=True))) == (6, 10)
