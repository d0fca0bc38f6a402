"""The loopback address, as OpenAI's API, by which agent.py reaches the language model of `trial.llm`.

Programs find it by OPENAI_BASE_URL and OPENAI_API_KEY, so any client, thread or policy uses it. It alone knows the key.
It asks only for the models in config.yml, counts and caps, writes each call on the tape, and answers from the tape of
an earlier server what that server has paid for.
"""

from __future__ import annotations

import hmac
import http.client
import json
import logging
import secrets
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Protocol
from urllib.parse import urlsplit

from hippodrome.protocol.trial_llm import LlmSection
from hippodrome.trial.llm import client
from hippodrome.trial.llm.client import OWN
from hippodrome.trial.llm.ledger import Call, Ledger, Moment, Refused, Tokens, estimate, tokens_of
from hippodrome.trial.llm.upstream import Answer, Failed, Upstream

log = logging.getLogger("trial")

PATHS = ("/chat/completions", "/responses", "/embeddings")
"""The paths below `/v1` that are passed on."""
MAX_REQUEST = 4 * 1024 * 1024
"""The most bytes of a request."""
CLOSED_SECONDS = 60.0
"""A call waits so long if the server is ending: by then its process has ended."""
_IDLE = 600.0  # seconds for which a client may keep a connection without a request
_ROOT = "/v1"


class Tape(Protocol):
    """Where calls are recorded."""

    def add(self, record: dict[str, Any]) -> None:
        """Add a record, on any thread."""


class NoTape:
    """A tape that keeps nothing."""

    def add(self, record: dict[str, Any]) -> None:
        """Forget the record."""


@dataclass(slots=True)
class Game:
    """The game whose calls are made now. `now` says when in the game it is."""

    section: LlmSection
    ledger: Ledger
    tape: Tape
    now: Callable[[], Moment]


class Endpoint:
    """The loopback address. `url` replaces `llm.url`, for the fake of `check` and `try`."""

    def __init__(self, key: str, url: str = "") -> None:
        self._key = key
        self._url = url
        self._game: Game | None = None
        self._changed = threading.Condition()
        self._under_way = 0
        self._closed = False
        self.token = secrets.token_urlsafe(24)
        """What clients must show. It is good for this address alone."""
        self._server = _Server(("127.0.0.1", 0), _Handler, self)
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="llm", daemon=True).start()

    @property
    def url(self) -> str:
        """The address, for a client of OpenAI's API."""
        return f"http://127.0.0.1:{self._server.server_address[1]}{_ROOT}"

    def environment(self) -> dict[str, str]:
        """Return the variables by which clients find the address."""
        return {"OPENAI_BASE_URL": self.url, "OPENAI_API_KEY": self.token}

    def play(self, game: Game | None) -> None:
        """Make calls for this game from now on; None if the game that is played has no `llm`."""
        with self._changed:
            self._game = game

    def close(self, seconds: float) -> None:
        """Begin no further call, and wait at most `seconds` for those under way, which the tape then holds. Blocks."""
        with self._changed:
            self._closed = True
            self._changed.wait_for(lambda: not self._under_way, seconds)

    def stop(self) -> None:
        """End the address. Blocks for a tenth of a second."""
        self._server.shutdown()
        self._server.server_close()

    # ---- for the handlers' threads

    def models(self) -> list[str]:
        """Return the models that may be asked."""
        with self._changed:
            return list(self._game.section.model) if self._game else []

    def begin(self) -> Game:
        """Begin a request, which `done` ends. Raises Refused."""
        with self._changed:
            if self._closed:  # an error would become a fallback that the participant reads; the next server asks again
                self._changed.wait_for(lambda: False, CLOSED_SECONDS)
                raise Refused(503, "closed", "this server is ending; another one asks the model")
            if self._game is None:
                words = (
                    "no game with trial.llm is played; ask in reset, step, reply or a callback, and not before a game"
                )
                raise Refused(409, "no_game", words)
            self._under_way += 1
            return self._game

    def done(self) -> None:
        with self._changed:
            self._under_way -= 1
            self._changed.notify_all()

    def upstream(self, section: LlmSection) -> Upstream:
        """Return the way to the model."""
        return Upstream(self._url or section.url, self._key, section.seconds)

    def without_key(self, text: str) -> str:
        """Remove the key from what an API says, which may repeat it."""
        return text.replace(self._key, "[key]") if self._key else text


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    request_queue_size = 64

    def __init__(self, address: tuple[str, int], handler: type[BaseHTTPRequestHandler], endpoint: Endpoint) -> None:
        self.endpoint = endpoint
        super().__init__(address, handler)

    def handle_error(self, request: object, client_address: object) -> None:
        """Log no traceback: a client that has gone is no news, and the error of a request may quote it."""


class _Gone(Exception):
    """The client has closed its connection."""


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = _IDLE
    disable_nagle_algorithm = True

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""

    def do_GET(self) -> None:
        endpoint = self.server.endpoint
        try:
            path = self._path()
            if path != "/models":
                raise _no_path()
            models = [{"id": name, "object": "model", "owned_by": "llm.model"} for name in endpoint.models()]
            self._send(200, {"object": "list", "data": models})
        except Refused as refused:
            self._refuse(refused)

    def do_POST(self) -> None:
        endpoint = self.server.endpoint
        try:
            request, path = self._request(), self._path()
            if path not in PATHS:
                raise _no_path()
            game = endpoint.begin()
            try:
                self._answer(game, path, request)
            finally:
                endpoint.done()
        except Refused as refused:
            self._refuse(refused)
        except _Gone:
            self.close_connection = True

    # ---- reading

    def _path(self) -> str:
        """Return the path below `/v1`. Raises Refused if the client does not show the token."""
        shown = (self.headers.get("Authorization") or "").removeprefix("Bearer ")
        if not hmac.compare_digest(shown.encode(), self.server.endpoint.token.encode()):
            raise Refused(401, "wrong_token", "use the key in OPENAI_API_KEY; it is good for this address alone")
        return urlsplit(self.path).path.removeprefix(_ROOT)

    def _request(self) -> dict[str, Any]:
        """Return the body. Raises Refused."""
        length = self.headers.get("Content-Length") or ""
        if not length.isdecimal() or int(length) > MAX_REQUEST:
            self.close_connection = True  # what follows is not read
            words = f"a request must say its length, and have at most {MAX_REQUEST // 1024**2} MB"
            raise Refused(413, "too_large", words)
        try:
            request = json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError):
            raise Refused(400, "not_json", "the request is not JSON") from None
        if not isinstance(request, dict):
            raise Refused(400, "not_json", "the request must be a JSON object")
        return request

    # ---- answering

    def _answer(self, game: Game, path: str, request: dict[str, Any]) -> None:
        models = game.section.model
        if request.get("model") not in models:
            words = f"this model is not in llm.model, which has {', '.join(models)}"
            raise Refused(404, "model_not_found", words)
        call = game.ledger.begin(path, request, game.now())
        if call.recorded is not None:
            self._from_tape(call.recorded)
            return
        record: dict[str, Any] = {
            "kind": "call",
            "hash": call.hash,
            "nth": call.nth,
            "path": path,
            "model": request["model"],
            **({"request": request} if game.section.record == "requests" else {}),
            "time": datetime.now(UTC).isoformat(),
            "episode": call.moment.episode,
            "step": call.moment.step,
            **({} if call.moment.line is None else {"line": call.moment.line}),
        }
        began = time.monotonic()

        def ended(status: int, answer: Any, tokens: Tokens) -> None:
            """Put the call on the tape before the client has the whole answer: what it acts on is never lost."""
            game.ledger.end(tokens)
            milliseconds = round((time.monotonic() - began) * 1000)
            found = {"status": status, "answer": answer, "tokens": tokens.document(), "ms": milliseconds}
            game.tape.add(record | found)

        self._ask(game, path, request, call, ended)

    def _ask(
        self,
        game: Game,
        path: str,
        request: dict[str, Any],
        call: Call,
        ended: Callable[[int, Any, Tokens], None],
    ) -> None:
        sent, shows_usage = _with_usage(path, request)
        try:
            with self.server.endpoint.upstream(game.section).ask(path, sent) as answer:
                if answer.is_stream and answer.status == 200:
                    self._pass_stream(answer, request, shows_usage, ended)
                    return
                status, retry_after = answer.status, answer.retry_after
                body = b"".join(answer.pieces())
        except Failed as failed:
            error = _error(failed.code, str(failed))
            ended(failed.status, error, Tokens())
            self._send(failed.status, error)
            return
        status, found = self._read(status, body)
        tokens = Tokens()
        if status == 200:
            tokens = tokens_of(found) or estimate(request, client.length_of_answer(found))
        ended(status, found, tokens)
        self._send(status, found, {"Retry-After": retry_after} if retry_after and status != 200 else {})

    def _read(self, status: int, body: bytes) -> tuple[int, Any]:
        """Return the status and the JSON of an answer; an error of our own if it has no JSON."""
        text = self.server.endpoint.without_key(body.decode("utf-8", "replace"))
        try:
            return status, _as_theirs(json.loads(text))
        except (ValueError, RecursionError):
            pass
        if status < 400:
            return 502, _error("not_json", "the model's address does not answer with JSON; is llm.url right?")
        return status, _error(f"status_{status}", f"the model's API answers with status {status}")

    def _pass_stream(
        self,
        answer: Answer,
        request: dict[str, Any],
        shows_usage: bool,
        ended: Callable[[int, Any, Tokens], None],
    ) -> None:
        """Pass the events of a stream on as they come. The client gets the last one once the call is on the tape."""
        passed: list[str] = []
        tokens: Tokens | None = None
        length = 0
        waiting: str | None = None
        gone = False
        try:
            self._begin_stream()
            for event in self._events(answer):
                data = client.data_of(event)
                tokens = tokens_of(data) or tokens
                length += client.length_of_delta(data)
                if not shows_usage and client.is_usage_alone(data):
                    continue
                if waiting is not None:
                    self._write_event(waiting)
                waiting = event
                passed.append(event)
        except _Gone:
            gone = True  # no more is read, so the model may stop
        ended(200, passed, tokens or estimate(request, length))
        if gone:
            raise _Gone
        if waiting is not None:
            self._write_event(waiting)
        self._write(b"0\r\n\r\n")

    def _events(self, answer: Answer) -> Iterator[str]:
        """Yield the events of a stream; if it breaks off, an event with the error last."""
        reader, without_key = client.Reader(), self.server.endpoint.without_key

        def theirs(event: str) -> str:
            event = without_key(event)
            data = client.data_of(event)
            changed = _as_theirs(data)
            return event if changed is data else f"data: {json.dumps(changed)}"

        try:
            for piece in answer.pieces():
                for event in reader.feed(piece):
                    yield theirs(event)
            if rest := reader.rest():
                yield theirs(rest)
        except Failed as failed:
            yield f"data: {json.dumps(_error(failed.code, str(failed)))}"
        except TimeoutError:
            yield f"data: {json.dumps(_error('timeout', 'the model has not come to an end in time'))}"
        except (OSError, ValueError, http.client.HTTPException) as error:
            words = f"the model has broken off ({type(error).__name__})"
            yield f"data: {json.dumps(_error('unavailable', words))}"

    def _from_tape(self, record: Mapping[str, Any]) -> None:
        status, answer = int(record.get("status") or 502), record.get("answer")
        if status == 200 and isinstance(answer, list):
            self._begin_stream()
            for event in answer:
                self._write_event(str(event))
            self._write(b"0\r\n\r\n")
        else:
            self._send(status, answer)

    # ---- writing

    def _refuse(self, refused: Refused) -> None:
        self._send(refused.status, _error(refused.code, str(refused)), {"X-Should-Retry": "false"})

    def _send(self, status: int, answer: Any, headers: Mapping[str, str] | None = None) -> None:
        body = json.dumps(answer).encode()
        try:
            self.send_response(status)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(body)))
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)
        except OSError:
            self.close_connection = True

    def _begin_stream(self) -> None:
        try:
            self.send_response(200)
            self.send_header("Content-Type", "text/event-stream; charset=utf-8")
            self.send_header("Cache-Control", "no-cache")
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
        except OSError:
            raise _Gone from None

    def _write_event(self, event: str) -> None:
        data = f"{event}\n\n".encode()
        self._write(b"%x\r\n%b\r\n" % (len(data), data))

    def _write(self, data: bytes) -> None:
        try:
            self.wfile.write(data)
        except OSError:
            raise _Gone from None


def _no_path() -> Refused:
    paths = ", ".join(f"{_ROOT}{path}" for path in PATHS)
    return Refused(404, "not_found", f"here are only {paths} (POST) and {_ROOT}/models (GET)")


def _error(code: str, words: str) -> dict[str, Any]:
    return {"error": {"message": words, "type": OWN, "code": code}}


def _as_theirs(answer: Any) -> Any:
    """Return the answer of the model's API; its error has another type if it has that of our own, which are trusted."""
    error = answer.get("error") if isinstance(answer, dict) else None
    if not isinstance(error, dict) or error.get("type") != OWN:
        return answer
    return {**answer, "error": {**error, "type": "upstream"}}


def _with_usage(path: str, request: dict[str, Any]) -> tuple[dict[str, Any], bool]:
    """Return the request that also asks a stream for its tokens, and whether the client had asked so itself."""
    if path != "/chat/completions" or request.get("stream") is not True:
        return request, True
    options = request.get("stream_options")
    options = options if isinstance(options, dict) else {}
    if options.get("include_usage") is True:
        return request, True
    return {**request, "stream_options": {**options, "include_usage": True}}, False
