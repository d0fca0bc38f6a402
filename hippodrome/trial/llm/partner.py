"""A partner made of a language model alone: the `reply` of a study that has none of its own, and `session.ask`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hippodrome.protocol.trial_llm import LlmSection, prompt_file
from hippodrome.trial.llm import client
from hippodrome.trial.llm.ledger import text_hash

_BEGIN = "(Nobody has said anything yet. Say your first line.)"


class NoPrompt(Exception):
    """The file of the prompt cannot be read. The message is for the researcher."""


def prompt_of(section: LlmSection, folder: Path) -> str | None:
    """Return the prompt that `llm.system` is or names; None if there is none. Raises NoPrompt."""
    file = None if section.system is None else prompt_file(section.system)
    if file is None:
        return section.system
    try:
        return (folder / file).read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise NoPrompt(f"the prompt {file} cannot be read ({type(error).__name__})") from None


class Partner:
    """The language model of a game, as `section` describes it, with its prompt."""

    def __init__(self, section: LlmSection, prompt: str | None) -> None:
        self._section = section
        self._prompt = prompt

    def hashes(self) -> dict[str, str]:
        """Return what tells the model and the prompt from those of other conditions, for the answer."""
        prompt = {} if self._prompt is None else {"prompt": text_hash(self._prompt)}
        return {"model": self._section.model[0], **prompt}

    def ask(self, text: str, **parameters: Any) -> str:
        """Ask a question, with the prompt before it, and return the answer. `parameters` as `client.ask`'s.

        Raises ModelError.
        """
        parameters.setdefault("system", self._prompt)
        return client.ask(text, **{**self._section.parameters, **parameters})

    def reply(self, session: Any, player: str, text: str) -> Iterator[str]:
        """Yield the pieces of the answer to a line, as the agent's own `reply` would. Raises ModelError.

        While an earlier server's steps are repeated, it says nothing: the talk has its lines already.
        """
        if not session.replaying:
            yield from client.stream(messages(self._prompt, session.talk, session.humans), self._section.parameters)


def messages(prompt: str | None, talk: Sequence[dict[str, Any]], humans: Sequence[str]) -> list[dict[str, str]]:
    """Return a talk as messages for a model.

    Of several participants each has their name before their words, which are one line then: a second one could begin
    with another's name.
    """

    def words(line: dict[str, Any]) -> str:
        return f"{line['by']}: {line['text']}".replace("\n", " ") if len(humans) > 1 else str(line["text"])

    said = [
        {"role": "user", "content": words(line)}
        if line["by"] in humans
        else {"role": "assistant", "content": line["text"]}
        for line in talk
    ]
    if not any(message["role"] == "user" for message in said):
        said.append({"role": "user", "content": _BEGIN})
    return [*([{"role": "system", "content": prompt}] if prompt else []), *said]
