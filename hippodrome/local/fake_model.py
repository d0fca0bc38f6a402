"""A stand-in for a language model, as OpenAI's API, on this machine: it costs nothing and always says the same.

`hippodrome check` and `try` use it, and `run` if it has no LLM_KEY. What it does wrong is chosen by the variable
FAKE_MODEL: words with commas between them, such as `delay:2,refuse:3`.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import threading
import time
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

VARIABLE = "FAKE_MODEL"
_WORDS = {
    "delay": "seconds before each answer",
    "pace": "seconds between two words of a stream",
    "refuse": "each so many-th request is refused, as by a filter",
    "fail": "each so many-th request fails, as on a broken server",
    "limit": "after so many requests, all others are too many",
}


def behaviour_of(text: str) -> dict[str, float]:
    """Return what the variable FAKE_MODEL says. Raises ValueError with what to write."""
    behaviour = {}
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, _, value = part.partition(":")
        if name not in _WORDS or not re.fullmatch(r"[0-9]+(\.[0-9]+)?", value):
            words = ", ".join(f"{name}:N ({meaning})" for name, meaning in _WORDS.items())
            raise ValueError(f"{VARIABLE} has {part!r}; it may have {words}")
        behaviour[name] = float(value)
    return behaviour


class FakeModel:
    """The stand-in, on a free port of this machine, from its creation to `stop`."""

    def __init__(self, behaviour: Mapping[str, float] | None = None) -> None:
        """`behaviour`: what it does wrong; by default what FAKE_MODEL says. Raises ValueError if that is wrong."""
        self.behaviour = behaviour_of(os.environ.get(VARIABLE, "")) if behaviour is None else behaviour
        self.requests: list[tuple[str, dict[str, Any], dict[str, str]]] = []
        """The path, the body and the headers of each request so far."""
        self.times: list[float] = []
        """When each came (`time.monotonic`)."""
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), type("_Of", (_Handler,), {"model": self}))
        self._server.daemon_threads = True
        threading.Thread(target=self._server.serve_forever, args=(0.1,), name="fake model", daemon=True).start()

    @property
    def url(self) -> str:
        """The address, as `llm.url` has it."""
        return f"http://127.0.0.1:{self._server.server_address[1]}/v1"

    def stop(self) -> None:
        """End it."""
        self._server.shutdown()
        self._server.server_close()


def reply_to(text: str) -> str:
    """Return what the stand-in says to a text."""
    words = " ".join(text.split())
    shown = words if len(words) <= 80 else f"{words[:79]}…"
    return f"(no real model) I read: {shown or 'nothing'}"


class _Handler(BaseHTTPRequestHandler):
    model: FakeModel
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing."""

    def handle(self) -> None:
        try:
            super().handle()
        except OSError:  # the client has gone
            self.close_connection = True

    def do_POST(self) -> None:
        request = json.loads(self.rfile.read(int(self.headers.get("Content-Length") or 0)) or b"{}")
        path = self.path.removeprefix("/v1")
        self.model.times.append(time.monotonic())
        self.model.requests.append((path, request, dict(self.headers)))
        count, behaviour = len(self.model.requests), self.model.behaviour
        time.sleep(behaviour.get("delay", 0))
        for name, status, code in (("refuse", 400, "content_filter"), ("fail", 500, "server_error")):
            if name in behaviour and count % int(behaviour[name]) == 0:
                self._send(status, {"error": {"message": f"refused by {VARIABLE}", "type": "fake", "code": code}})
                return
        if "limit" in behaviour and count > behaviour["limit"]:
            self._send(429, {"error": {"message": "too many requests", "type": "fake", "code": "rate_limit"}})
            return
        self.answer(path, request)

    def answer(self, path: str, request: dict[str, Any]) -> None:
        """Answer a request that is not refused."""
        if path == "/embeddings":
            input_given = request.get("input")
            texts = input_given if isinstance(input_given, list) else [input_given]
            vectors = [[byte / 255 for byte in hashlib.sha256(str(text).encode()).digest()[:8]] for text in texts]
            data = [{"object": "embedding", "index": n, "embedding": vector} for n, vector in enumerate(vectors)]
            usage = {"prompt_tokens": len(texts), "total_tokens": len(texts)}
            self._send(200, {"object": "list", "model": request.get("model"), "data": data, "usage": usage})
            return
        chat = path == "/chat/completions"
        said = reply_to(_last_text(request.get("messages") if chat else request.get("input")))
        used = _tokens(json.dumps(request.get("messages") if chat else request.get("input"))), _tokens(said)
        if request.get("stream") is True:
            self._stream(_chat_events(request, said, used) if chat else _response_events(request, said, used))
        else:
            self._send(200, _chat(request, said, used) if chat else _response(request, said, used))

    def _send(self, status: int, answer: Any) -> None:
        body = json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def _stream(self, events: Iterator[str]) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.send_header("Transfer-Encoding", "chunked")
        self.end_headers()
        for event in events:
            data = f"{event}\n\n".encode()
            self.wfile.write(b"%x\r\n%b\r\n" % (len(data), data))
            time.sleep(self.model.behaviour.get("pace", 0))
        self.wfile.write(b"0\r\n\r\n")


def _last_text(messages: Any) -> str:
    """The text of the last message of a request, or the text that is the request."""
    if isinstance(messages, list):
        messages = next((message.get("content") for message in reversed(messages) if isinstance(message, dict)), "")
    if isinstance(messages, list):  # with pictures, a content has parts
        messages = " ".join(str(part.get("text", "")) for part in messages if isinstance(part, dict))
    return messages if isinstance(messages, str) else ""


def _tokens(text: str) -> int:
    return -(-len(text) // 4)


def _usage(used: tuple[int, int]) -> dict[str, int]:
    return {"prompt_tokens": used[0], "completion_tokens": used[1], "total_tokens": sum(used)}


def _chat(request: Mapping[str, Any], text: str, used: tuple[int, int]) -> dict[str, Any]:
    message = {"role": "assistant", "content": text}
    return {
        "id": "fake",
        "object": "chat.completion",
        "created": 0,
        "model": request.get("model"),
        "choices": [{"index": 0, "message": message, "finish_reason": "stop"}],
        "usage": _usage(used),
    }


def _chat_events(request: Mapping[str, Any], text: str, used: tuple[int, int]) -> Iterator[str]:
    chunk = {"id": "fake", "object": "chat.completion.chunk", "created": 0, "model": request.get("model")}
    for piece in re.findall(r"\s*\S+", text):
        choice = {"index": 0, "delta": {"content": piece}, "finish_reason": None}
        yield f"data: {json.dumps({**chunk, 'choices': [choice]})}"
    yield f"data: {json.dumps({**chunk, 'choices': [{'index': 0, 'delta': {}, 'finish_reason': 'stop'}]})}"
    if (request.get("stream_options") or {}).get("include_usage"):
        yield f"data: {json.dumps({**chunk, 'choices': [], 'usage': _usage(used)})}"
    yield "data: [DONE]"


def _response(request: Mapping[str, Any], text: str, used: tuple[int, int]) -> dict[str, Any]:
    content = [{"type": "output_text", "text": text, "annotations": []}]
    message = {"id": "fake", "type": "message", "role": "assistant", "status": "completed", "content": content}
    return {
        "id": "fake",
        "object": "response",
        "created_at": 0,
        "status": "completed",
        "model": request.get("model"),
        "output": [message],
        "parallel_tool_calls": False,
        "tool_choice": "auto",
        "tools": [],
        "usage": {
            "input_tokens": used[0],
            "input_tokens_details": {"cached_tokens": 0},
            "output_tokens": used[1],
            "output_tokens_details": {"reasoning_tokens": 0},
            "total_tokens": sum(used),
        },
    }


def _response_events(request: Mapping[str, Any], text: str, used: tuple[int, int]) -> Iterator[str]:
    number = 0
    for number, piece in enumerate(re.findall(r"\s*\S+", text)):
        place = {"item_id": "fake", "output_index": 0, "content_index": 0, "sequence_number": number}
        yield _named("response.output_text.delta", {"delta": piece, "logprobs": [], **place})
    yield _named("response.completed", {"response": _response(request, text, used), "sequence_number": number + 1})


def _named(kind: str, data: Mapping[str, Any]) -> str:
    return f"event: {kind}\ndata: {json.dumps({'type': kind, **data})}"
