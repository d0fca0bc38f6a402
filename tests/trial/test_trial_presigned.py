"""A server without rights reads and stores everything by presigned requests, which it asks for one by one."""

import contextlib
import json
import os
import socket
import ssl
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from cryptography import x509

from hippodrome.control.certificates.rules import location
from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Reason
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import handover_key, waiting_key
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings import store as stores
from hippodrome.trial.recordings.store import PresignedStore, StoreError, store_file
from testing.strict_s3 import StrictS3
from testing.studies import study
from testing.waiting import until_async
from tests.trial.test_trial_tls import certificate

USER = "P1"
UI = {"stop": True, "start": True}
LABEL = ids.server_label("study", USER)
FOLDER = f"study/users/{USER}"
ANSWER = f"{FOLDER}/answers/3.json"


class Town(StrictS3):
    """The bucket with the records of our participant's servers."""

    def start(self, user=USER, attempt=1, before=None, **change):
        """Write the record of a server that starts; return its environment variables."""
        made = self._new(user, attempt, nonce=f"nonce-{attempt}")
        return self.keep(server.replacing(before, made) if before else made, **change)

    def start_warm(self):
        """Write the record of a warm server, which is ready."""
        owner = "~" + "0" * 20
        return self.keep(server.ready(self._new(owner, nonce="n"), self.now()))

    def hand_over(self, warm, user):
        """Assign the warm server to the participant or session, as `start_server` does; the server's new name."""
        label = ids.server_label("study", user)
        self.keep(server.handed_over(warm, label, self.now()))
        mine = server.reserving(self._new(user, nonce="m"), warm)
        self.keep(server.assigned(mine, warm, self.now()))
        own = ids.server_name(label, 1)
        with self.lock:
            self.documents.put(handover_key("study", warm.name), Handover(user, None, own).to_json())
        return own

    def _new(self, user, attempt=1, **secrets):
        return server.new_attempt(study(id="study"), user, attempt, settings=self.settings, now=self.now(), **secrets)

    def close(self, record, reason=Reason.STOPPED):
        return self.keep(server.close(record, reason, self.now()))

    def store(self, record):
        told = self.variables(record)
        return PresignedStore(told["STORE"], told["SERVER"], told["CREDENTIAL"], pause=lambda _: None)

    def body(self, key):
        with self.lock:
            found = self.documents.kept.get(key)
            return found and found[0]

    def recordings(self, name):
        with self.lock:
            start = f"{FOLDER}/trials/{name}/"
            return {key: recording.read(kept[0]) for key, kept in self.documents.kept.items() if key.startswith(start)}


@pytest.fixture
def town():
    with Town().serving() as made:
        yield made


async def play_game(launched, open_client, *, frames=10, stop=True):
    async with open_client(launched.address) as client:
        await client.play(frames)
        if stop:
            await client.say(command="stop")
            await client.until(lambda: client.done)
        return client


async def test_a_game_is_stored_by_presigned_requests_alone(town, launch, open_client):
    record = town.start()
    running = launch(trial={"ui": UI}, **town.variables(record))
    await play_game(running, open_client)
    assert running.wait() == 0
    assert json.loads(town.body(ANSWER))["answers"]["outcome"] == "stopped"
    ((key, lines),) = town.recordings(record.name).items()
    assert key.endswith("/3-episode-0001.jsonl.gz")
    assert lines[0]["kind"] == "header"
    refused = [seen for seen in town.requests if seen[2] not in (200, 404)]
    assert refused == []
    assert {method for method, path, _ in town.requests if path == "/sign"} == {"POST"}
    assert not running.store.exists()


async def test_what_people_say_is_stored_while_they_play_and_the_next_server_reads_it(town, launch, open_client):
    record = town.start()
    trial = {"ui": UI, "chat": True, "players": {}}
    running = launch(trial=trial, **town.variables(record))
    async with open_client(running.address) as client:
        await client.enter()
        for number in range(1, 4):
            town.failing = [500, 403]
            await client.say(say={"id": number, "text": f"Line {number}"})
            key = f"{FOLDER}/trials/{record.name}/3-talk-{number:04d}.json"
            await client.read(number)
            await until_async(lambda key=key: town.body(key) is not None)
        running.process.kill()
        await client.closed()
    lost = town.close(record, Reason.LOST)
    second = town.start(attempt=2, before=lost)
    running = launch(trial=trial, **town.variables(second))
    async with open_client(running.address) as client:
        await client.enter()
        assert [text for _, text in await client.read(3)] == ["Line 1", "Line 2", "Line 3"]


def test_the_certificate_comes_by_presigned_requests_too(town, launch, open_client):
    record = town.start()
    files = location(record.domain)
    chain, private = certificate(7)
    with town.lock:
        town.documents.put(files.fullchain, chain)
        town.documents.put(files.privkey, private)
    keys = {"SSL_FULLCHAIN": files.fullchain, "SSL_PRIVKEY": files.privkey, "TLS": "on"}
    running = launch(trial={"ui": UI}, **town.variables(record), **keys)
    shown = ssl.get_server_certificate(("127.0.0.1", running.port))
    assert x509.load_pem_x509_certificate(shown.encode()).serial_number == 7
    assert {path.rpartition("/")[2] for method, path, status in town.requests if (method, status) == ("GET", 200)} == {
        "fullchain.pem",
        "privkey.pem",
    }


async def test_neither_the_log_nor_the_agent_gets_a_secret(town, launch, open_client):
    record = town.start()
    spy = "\nimport os, sys\nprint(sorted(os.environ), file=sys.stderr, flush=True)\n"
    from tests.trial.conftest import grid_agent

    running = launch(agent=grid_agent() + spy, trial={"ui": UI}, **town.variables(record))
    town.failing = [500, 403]
    await play_game(running, open_client)
    assert running.wait() == 0
    said = running.log_text()
    assert "CREDENTIAL" not in said
    assert "TOKEN" not in said
    for secret in (town.variables(record)["CREDENTIAL"], "X-Amz", USER + "/", "127.0.0.1:"):
        assert secret not in said


async def test_the_next_server_goes_on_where_a_lost_one_was(town, launch, open_client):
    first = town.start()
    running = launch(trial={"ui": UI}, **town.variables(first))
    await play_game(running, open_client, frames=30, stop=False)
    lost = town.close(first, Reason.LOST)  # its end is known before it has stored what it recorded
    running.terminate()
    assert running.wait() == 0
    (before,) = town.recordings(first.name).values()
    second = town.start(attempt=2, before=lost)
    after = launch(trial={"ui": UI}, **town.variables(second))
    client = await play_game(after, open_client)
    assert after.wait() == 0
    assert client.errors == []
    (lines,) = town.recordings(second.name).values()
    assert [line["kind"] for line in lines[:2]] == ["header", "resume"]
    assert lines[0]["seed"] == before[0]["seed"]


async def test_the_answer_of_a_game_that_ended_before_the_stop_message_is_stored_after_it(town, launch, open_client):
    record = town.start()
    running = launch(trial={"ui": UI}, LINGER_SECONDS="30", **town.variables(record))
    async with open_client(running.address) as client:
        await client.play(10)
        town.failing = [503] * 100_000  # S3 is busy while the game ends
        await client.say(command="stop")
        await client.until(lambda: client.state.get("state") == "ended")
        assert town.body(ANSWER) is None
        town.close(record)
        running.terminate()
        town.failing = []
        with contextlib.suppress(Exception):
            await client.closed()
    assert running.wait(40) == 0
    assert town.body(ANSWER) is not None
    assert town.recordings(record.name)


async def test_a_warm_server_learns_its_participant_and_stores_in_their_folder(town, launch, open_client):
    warm_server = town.start_warm()
    running = launch(
        trial={"ui": UI}, WARM_SERVER="on", USER_ID="", ASSIGNMENT_SECONDS="0.2", **town.variables(warm_server)
    )
    time.sleep(0.5)
    own = town.hand_over(warm_server, USER)
    await play_game(running, open_client)
    assert running.wait() == 0
    assert town.body(ANSWER) is not None
    assert town.recordings(own)


def test_create_returns_false_for_a_name_that_is_taken_and_raises_if_refused(town):
    store = town.store(town.start())
    assert store.get(ANSWER) is None
    assert store.create(ANSWER, b"{}") is True
    assert store.create(ANSWER, b"[]") is False
    assert store.get(ANSWER) == b"{}"
    with pytest.raises(StoreError, match="HTTP 403"):
        store.create(f"{FOLDER}/answers/1.json", b"{}")


def test_a_file_is_stored_whole(town, tmp_path):
    path, record = tmp_path / "recording", town.start()
    path.write_bytes(os.urandom(300_000))
    key = f"{FOLDER}/trials/{record.name}/3-trial.jsonl.gz"
    assert town.store(record).create(key, path) is True
    assert town.body(key) == path.read_bytes()


async def test_a_recording_is_stored_once_if_the_answer_to_its_request_is_lost(town, tmp_path, monkeypatch):
    record, path, losses = town.start(), tmp_path / "recording", iter([True])
    key = f"{FOLDER}/trials/{record.name}/3-trial.jsonl.gz"
    path.write_bytes(b"the recording")
    send = stores._send

    def send_and_lose_the_first_put(request, *more):
        reply = send(request, *more)
        if request["method"] == "PUT" and next(losses, False):
            raise StoreError("no answer: TimeoutError")
        return reply

    monkeypatch.setattr(stores, "_send", send_and_lose_the_first_put)
    await store_file(town.store(record), key, path)
    assert [each for each in town.documents.kept if each.startswith(FOLDER)] == [key]
    assert not path.exists()
    assert town.store(record).create(key, b"the recording") is False


@pytest.mark.parametrize("statuses", [[], [503, 403]])
async def test_another_recording_with_the_same_name_is_stored_under_a_number(town, tmp_path, statuses):
    record, path = town.start(), tmp_path / "recording"
    folder = f"{FOLDER}/trials/{record.name}"
    town.documents.put(f"{folder}/3-trial.jsonl.gz", b"that of an earlier process")
    path.write_bytes(b"the recording")
    town.failing = list(statuses)  # S3 refuses the first requests
    await store_file(town.store(record), f"{folder}/3-trial.jsonl.gz", path)
    assert town.body(f"{folder}/3-trial.jsonl.gz") == b"that of an earlier process"
    assert town.body(f"{folder}/3-trial-2.jsonl.gz") == b"the recording"


def test_a_refusal_that_comes_before_the_body_is_sent_is_read(tmp_path):
    """S3 may say that a name is taken before it has read the megabytes of the body; else the recording would be sent for ever."""
    path = tmp_path / "recording"
    path.write_bytes(bytes(20_000_000))
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def refuse():
            connection, _ = listening.accept()
            with connection:
                connection.recv(1000)
                connection.sendall(
                    b"HTTP/1.1 412 Precondition Failed\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
                )

        thread = threading.Thread(target=refuse)
        thread.start()
        url = f"http://127.0.0.1:{listening.getsockname()[1]}/bucket/key"
        with path.open("rb") as body:
            request = {"method": "PUT", "url": url, "headers": {"Content-Length": "20000000"}}
            assert stores._send(request, body) == (412, b"")
        thread.join()


@pytest.mark.parametrize("statuses", [[403], [400], [500, 503], [409, 429, 403]])
def test_reading_tries_again_after_errors_that_may_pass(town, statuses):
    store = town.store(town.start())
    store.create(ANSWER, b"{}")
    town.failing = list(statuses)
    signed = len(town.requests)
    assert store.get(ANSWER) == b"{}"
    asked = [path for _, path, _ in town.requests[signed:] if path == "/sign"]
    assert len(asked) == len(statuses) + 1, "each time with a new request"


def test_reading_gives_up_after_some_time_and_says_so_without_names(town):
    store = town.store(town.start())
    town.failing = [500] * 50
    with pytest.raises(StoreError) as error:
        store.get(ANSWER)
    assert len(town.failing) == 50 - len(stores.PAUSES) - 1
    assert error.value.strerror == "the answer was HTTP 500"


def test_a_request_that_has_expired_is_refused_and_a_new_one_is_taken(town, monkeypatch):
    record = town.start()
    store = town.store(record)
    store.create(ANSWER, b"{}")
    old = town.signer.presign_get(ANSWER, 1)
    time.sleep(1.1)
    assert stores._send({"method": "GET", "url": old.url, "headers": {}}, None)[0] == 403
    assert store.get(ANSWER) == b"{}"


def test_an_error_without_an_answer_contains_no_address(town):
    store = PresignedStore("http://127.0.0.1:1/sign", "s", "c", pause=lambda _: None)
    with pytest.raises(StoreError) as error:
        store.get(ANSWER)
    assert error.value.strerror == "no answer: ConnectionRefusedError"
    assert error.value.__cause__ is None


def test_of_two_servers_that_store_the_same_answer_one_wins(town):
    store = town.store(town.start())
    with ThreadPoolExecutor(6) as pool:
        won = list(pool.map(lambda n: store.create(ANSWER, b"%d" % n), range(6)))
    assert sorted(won) == [False] * 5 + [True]


def test_a_presigned_request_is_used_again_until_it_is_refused(town):
    """A document that is read every two seconds is not signed every two seconds."""
    project = study(id="study", players=2, matching="match")
    record = town.keep(
        server.new_attempt(project, "s." + "0" * 20, 1, nonce="n", settings=town.settings, now=town.now())
    )
    store, key = town.store(record), waiting_key("study")
    assert [store.look(key), store.look(key)] == [None, None]
    town.documents.put(key, b"{}")
    assert store.look(key) == b"{}"
    assert [path for _, path, _ in town.requests].count("/sign") == 1
    town.failing = [403]  # the request has expired
    assert store.look(key) == b"{}"
    assert [path for _, path, _ in town.requests].count("/sign") == 2
    town.failing = [403, 403]
    with pytest.raises(StoreError):
        store.look(key)
    assert store.look(key) == b"{}"
