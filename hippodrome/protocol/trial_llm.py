"""The section `llm` in `trial` of config.yml: the language model that answers, or that agent.py asks (docs/talk.md)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any
from urllib.parse import urlsplit

from hippodrome.protocol import section_keys as keyed
from hippodrome.protocol import values
from hippodrome.protocol.loopback import LOOPBACK
from hippodrome.protocol.section_keys import Section

MAX_MODELS = 20
MAX_PROMPT = 2_000  # characters of a prompt in config.yml; a file may be longer
MAX_PROMPT_FILE = 64 * 1024
"""The most bytes of a prompt's file."""
_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_PROMPT_FILES = (".txt", ".md")


def _url(value: object) -> str:
    """Return the address without a slash at its end. Raises ValueError with what to write."""
    url = values.as_text(value, "the address of the model's API, such as https://example.org/v1").rstrip("/")
    try:
        parts = urlsplit(url)
        host, _ = parts.hostname, parts.port  # `port` raises ValueError if it is no number
    except ValueError:
        raise ValueError(f"must be an address such as https://example.org/v1, not {values.show(value)}") from None
    if not host or parts.scheme not in ("https", "http") or parts.query or parts.fragment or " " in url:
        raise ValueError(f"must be an address such as https://example.org/v1, not {values.show(value)}")
    if parts.username or parts.password:
        raise ValueError("must be without a name or a password; the key belongs into the variable LLM_KEY")
    if parts.scheme == "http" and host not in LOOPBACK:
        raise ValueError("must begin with https://, so that nobody on the way reads the key and what people say")
    return url


def _prompt(value: object) -> str:
    """Return a prompt, which may have several lines, or the name of its file. Raises ValueError with what to write."""
    text = value.text if isinstance(value, values.Plain) else value
    if not isinstance(text, str) or not text.strip():
        raise ValueError(f"must be a text, or a file of the study such as prompts/warm.txt, not {values.show(value)}")
    text = text.strip()
    if _CONTROL.search(text):
        raise ValueError("must not hold invisible characters; take them out")
    if len(text) > MAX_PROMPT:
        raise ValueError(
            f"must be at most {MAX_PROMPT} characters long, not {len(text)}; write it into a file such as "
            "prompts/partner.txt, and that file's name here"
        )
    file = prompt_file(text)
    if file is not None and (file.startswith("/") or ".." in PurePosixPath(file).parts or "\\" in file):
        raise ValueError(f"must be a file below the folder of agent.py, such as prompts/warm.txt, not {text}")
    return text


def prompt_file(system: str) -> str | None:
    """Return the file that the key `system` names: one word that ends in .txt or .md. None if it is the prompt."""
    return system if system.endswith(_PROMPT_FILES) and len(system.split()) == 1 else None


def _price(value: object) -> dict[str, float] | None:
    """Check `price`, and return it; None if it is left out."""
    if value is None:
        return None
    if not isinstance(value, dict) or {*value} != {"input", "output"}:
        raise ValueError("must be the price of a million tokens, such as {input: 0.5, output: 1.5}")
    return {name: float(str(values.number(0, 1_000_000)(value[name]))) for name in ("input", "output")}


@dataclass(frozen=True, slots=True)
class LlmSection(Section):
    """The section `llm`: a language model behind an address that speaks as OpenAI's does."""

    url: str = keyed.key(
        _url,
        "",
        "The address of the API, to which `/chat/completions` is added; https, or this machine.",
        {"type": "string"},
        otherwise="needed",
        example="https://api.example.org/v1",
    )
    model: tuple[str, ...] = keyed.items(
        "model",
        MAX_MODELS,
        values.text("the name of a model", 200),
        (),
        "The models that may be asked; the first answers unless agent.py asks for another.",
        single=True,
        kind="a name, or a list",
        otherwise="needed",
        example="small-model-1",
    )
    system: str | None = keyed.key(
        _prompt,
        None,
        "The prompt: what the model is told before the conversation. A text, or a file of the study (.txt or .md).",
        {"type": "string"},
        kind="a text, or a file",
        otherwise="no prompt",
        example='"prompts/{persona}.txt"',
    )
    parameters: dict[str, Any] = keyed.key(
        values.options,
        {},
        "Further parameters of each request by `reply` and `ask`, as the API names them.",
        {"type": "object"},
        kind="section",
        example="{temperature: 0.7}",
    )
    max_calls: int = keyed.whole(
        1, 1_000_000, 200, "The most requests in one game; a request that failed counts, too.", example="50"
    )
    max_tokens: int = keyed.whole(
        1,
        10**9,
        50_000,
        "The most tokens in one game, of requests and answers together. No request begins after that.",
        example="20000",
    )
    seconds: float = keyed.seconds(600, 60, "The time for one answer, in all.", least=1, example="20")
    fallback: str = keyed.text(
        "Sorry, I cannot answer right now.",
        "What the partner says if the model cannot answer.",
        example="One moment, please.",
    )
    record: str = keyed.choice(
        ("requests", "hashes"),
        "`requests`: the tape holds each request as it was sent. `hashes`: its hash alone. Answers are held anyway.",
        example="hashes",
    )
    price: dict[str, float] | None = keyed.key(
        _price,
        None,
        "The price of a million tokens; `hippodrome check` and `hippodrome cost` say what it can come to.",
        {
            "type": ["object", "null"],
            "properties": {"input": {"type": "number", "minimum": 0}, "output": {"type": "number", "minimum": 0}},
            "required": ["input", "output"],
            "additionalProperties": False,
        },
        kind="`{input: …, output: …}`",
        example="{input: 0.5, output: 1.5}",
    )
