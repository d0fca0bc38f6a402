"""Asks the language model of `trial.llm` by the loopback address. No other module of the server is needed for it."""

from __future__ import annotations

import codecs
import http.client
import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

OWN = "hippodrome"
"""The type of the loopback address's own errors. No error of a model's API keeps it."""


class ModelError(Exception):
    """The model has not answered. The message says why, without words of prompts and answers."""


class CapReached(ModelError):
    """The game has used up `llm.maxCalls` or `llm.maxTokens`."""


class ModelUnavailable(ModelError):
    """The model cannot be reached, is too slow, has too much to do, or has broken off."""


class ModelRefused(ModelError):
    """The model's API refuses the request, or the model has declined to answer."""


_AGAIN = (429, 500, 502, 503, 504)
_PAUSES = (1.0, 3.0)  # seconds before a second and a third try
_LONGEST_PAUSE = 10.0  # seconds for which an API may make us wait
_SECONDS = 700.0  # the endpoint ends each call before


def ask(text: str, *, system: str | None = None, model: str | None = None, **parameters: Any) -> str:
    """Ask the model of `trial.llm` and return what it answers. Raises ModelError.

    `system` is what it is told before the question. `model` is the first in `llm.model` unless it is given.
    `parameters` are further parameters of the request, such as `temperature`.
    """
    messages = [{"role": "user", "content": text}]
    if system:
        messages.insert(0, {"role": "system", "content": system})
    return complete(messages, {**({"model": model} if model else {}), **parameters})


def complete(messages: Sequence[Mapping[str, Any]], parameters: Mapping[str, Any]) -> str:
    """Return the model's answer to these messages. Raises ModelError."""
    answer = _post({"model": parameters.get("model") or _first_model(), "messages": [*messages], **parameters})
    try:
        choice = answer["choices"][0]
        text, why = choice["message"].get("content") or "", choice.get("finish_reason")
    except (AttributeError, IndexError, KeyError, TypeError):
        raise ModelUnavailable("the model has answered without a choice") from None
    return _said(text, why)


def stream(messages: Sequence[Mapping[str, Any]], parameters: Mapping[str, Any]) -> Iterator[str]:
    """Yield the pieces of the model's answer to these messages as they come. Raises ModelError."""
    body = {"model": parameters.get("model") or _first_model(), "messages": [*messages], **parameters, "stream": True}
    connection, response = _opened(body)
    length, why = 0, None
    try:
        reader = Reader()
        while piece := response.read1(65_536):
            for event in reader.feed(piece):
                data = data_of(event)
                if isinstance(data, Mapping) and data.get("error"):
                    raise _error_of(502, data)
                why = end_of(data) or why
                if text := text_of_delta(data):
                    length += len(text)
                    yield text
    except (OSError, http.client.HTTPException) as error:
        raise ModelUnavailable(f"the answer has broken off ({type(error).__name__})") from None
    finally:
        connection.close()
    _said("x" * length, why)


def _said(text: str, why: Any) -> str:
    if why == "content_filter" or not text.strip():
        raise ModelRefused("the model has declined to answer")
    return text


def _first_model() -> str:
    status, answer = _sent("GET", "/models", None)
    if status != 200 or not answer["data"]:
        raise ModelUnavailable("no game with trial.llm is played; ask in reset, step, reply or a callback")
    return str(answer["data"][0]["id"])


def _post(body: Mapping[str, Any]) -> Any:
    connection, response = _opened(body)
    try:
        return json.loads(response.read())
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise ModelUnavailable(f"the answer cannot be read ({type(error).__name__})") from None
    finally:
        connection.close()


def _opened(body: Mapping[str, Any]) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
    """Return the connection with an answer that has the status 200. A busy API is asked again. Raises ModelError."""
    for pause in (*_PAUSES, None):
        connection, response = _request("POST", "/chat/completions", body)
        if response.status == 200:
            return connection, response
        try:
            answer = json.loads(response.read())
        except (OSError, ValueError, http.client.HTTPException):
            answer = None
        finally:
            connection.close()
        if (
            pause is None
            or response.status not in _AGAIN
            or _own_error(answer).get("code") not in (None, "unavailable")
        ):
            raise _error_of(response.status, answer)
        time.sleep(_pause(response.getheader("Retry-After"), pause))
    raise AssertionError


def _pause(retry_after: str | None, pause: float) -> float:
    try:
        return min(_LONGEST_PAUSE, max(0.0, float(retry_after or pause)))
    except ValueError:  # a date
        return pause


def _error_of(status: int, answer: Any) -> ModelError:
    """Return the error that an answer tells. Its message holds nothing of what an API says, which may quote prompts."""
    own = _own_error(answer)
    code, words = own.get("code"), str(own.get("message") or f"the model's API answers with status {status}")
    if code == "cap_reached":
        return CapReached(words)
    if status in _AGAIN or code in ("not_on_tape", "no_game"):
        return ModelUnavailable(words)
    return ModelRefused(words)


def _own_error(answer: Any) -> Mapping[str, Any]:
    """Return the error of the endpoint's own that an answer tells; {} for one of the model's API."""
    error = answer.get("error") if isinstance(answer, Mapping) else None
    return error if isinstance(error, Mapping) and error.get("type") == OWN else {}


def _sent(method: str, path: str, body: Mapping[str, Any] | None) -> tuple[int, Any]:
    connection, response = _request(method, path, body)
    try:
        return response.status, json.loads(response.read())
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise ModelUnavailable(f"the answer cannot be read ({type(error).__name__})") from None
    finally:
        connection.close()


def _request(
    method: str, path: str, body: Mapping[str, Any] | None
) -> tuple[http.client.HTTPConnection, http.client.HTTPResponse]:
    address = urlsplit(os.environ.get("OPENAI_BASE_URL", ""))
    if address.scheme != "http":
        raise ModelUnavailable("there is no address of a model here; write llm into trial of config.yml")
    connection = http.client.HTTPConnection(address.hostname or "", address.port, timeout=_SECONDS)
    headers = {"Authorization": f"Bearer {os.environ.get('OPENAI_API_KEY', '')}", "Content-Type": "application/json"}
    try:
        connection.request(method, address.path + path, None if body is None else json.dumps(body).encode(), headers)
        return connection, connection.getresponse()
    except (OSError, http.client.HTTPException) as error:
        connection.close()
        raise ModelUnavailable(f"the address of the model does not answer ({type(error).__name__})") from None


# ---- server-sent events, as language models stream their answers

_LINE_END = re.compile(r"\r\n|\n|\r")
_END = re.compile(r"\r\n\r\n|\n\n|\r\r")


class Reader:
    """Splits a stream's bytes into events: texts without the empty line at their end."""

    def __init__(self) -> None:
        self._decoder = codecs.getincrementaldecoder("utf-8")("replace")
        self._rest = ""

    def feed(self, piece: bytes) -> Iterator[str]:
        """Yield the events that end in this piece."""
        *whole, self._rest = _END.split(self._rest + self._decoder.decode(piece))
        yield from (event for event in whole if event)

    def rest(self) -> str:
        """Return what came after the last event."""
        return self._rest.strip()


def data_of(event: str) -> Any:
    """Return the JSON of an event; None if it has none, as `[DONE]`."""
    lines = [line[5:].removeprefix(" ") for line in _LINE_END.split(event) if line.startswith("data:")]
    try:
        return json.loads("\n".join(lines))
    except (ValueError, RecursionError):
        return None


def is_usage_alone(data: Any) -> bool:
    """Return whether this is the event with the tokens of a chat, which has no choice. Many clients expect a choice."""
    return isinstance(data, Mapping) and data.get("choices") == [] and isinstance(data.get("usage"), Mapping)


def text_of_delta(data: Any) -> str:
    """Return the text that an event of a chat's stream adds to the answer."""
    try:
        return str(data["choices"][0]["delta"].get("content") or "")
    except (AttributeError, IndexError, KeyError, TypeError):
        return ""


def length_of_delta(data: Any) -> int:
    """Return how many characters an event of a stream adds to the answer."""
    if isinstance(data, Mapping) and isinstance(data.get("delta"), str):  # of /responses
        return len(data["delta"])
    return len(text_of_delta(data))


def length_of_answer(answer: Any) -> int:
    """Return how many characters an answer has, roughly: those of all its texts beside names."""
    if isinstance(answer, str):
        return len(answer)
    if isinstance(answer, Mapping):
        texts = (
            answer.get(key) for key in ("choices", "message", "content", "output", "text", "tool_calls", "arguments")
        )
        return sum(map(length_of_answer, texts))
    return sum(map(length_of_answer, answer)) if isinstance(answer, list) else 0


def end_of(data: Any) -> str | None:
    """Return why a chat's stream ends with this event; None if it goes on."""
    try:
        why = data["choices"][0].get("finish_reason")
    except (AttributeError, IndexError, KeyError, TypeError):
        return None
    return why if isinstance(why, str) else None
