"""Taking a participant's identities out of what is to be shared: out of texts, and out of JSON written as text."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from export.state import ExportedParticipant

SHORTEST = 6  # characters; a shorter id or value stands in too many texts by chance
_SURROGATES = re.compile("[\ud800-\udfff]")


class Scrub:
    """Replaces identities wherever they stand in a text. `found` counts how often."""

    def __init__(self, identities: Mapping[str, str]) -> None:
        """From each identity to what stands in its place. Those shorter than `SHORTEST` are left where they are."""
        self.found = 0
        self._instead: dict[str, str] = {}
        for identity, instead in identities.items():
            if len(identity) >= SHORTEST:
                for form in (identity, json.dumps(identity)[1:-1], json.dumps(identity, ensure_ascii=False)[1:-1]):
                    self._instead.setdefault(form, instead)
                    self._instead.setdefault(form.lower(), instead)
        longest_first = sorted(self._instead, key=len, reverse=True)
        self._pattern = re.compile("|".join(map(re.escape, longest_first)), re.IGNORECASE) if longest_first else None

    def text(self, text: str) -> str:
        """The text without identities, and fit for UTF-8."""
        return clean(self._pattern.sub(self._replace, text) if self._pattern else text)

    def value(self, value: Any) -> Any:
        """The same for every text in a JSON value, keys too."""
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, Mapping):
            return {self.text(str(key)): self.value(item) for key, item in value.items()}
        if isinstance(value, list):
            return [self.value(item) for item in value]
        return value

    def _replace(self, found: re.Match[str]) -> str:
        self.found += 1
        return self._instead.get(found[0]) or self._instead.get(found[0].lower(), "(id)")


def nothing() -> Scrub:
    """One that takes nothing out."""
    return Scrub({})


def identities(participant: ExportedParticipant) -> dict[str, str]:
    """What gives a participant away, from `participant.json` and `session.json`, and what to write instead."""
    found = {value: f"({name})" for name, value in texts(participant.document.get("link")).items()}
    for document in (participant.document, participant.membership):
        if isinstance(code := document.get("completionCode"), str) and code:
            found[code] = "(completionCode)"
    return {**found, participant.user: participant.number}


def completion_code(participant: ExportedParticipant) -> str | None:
    """The code that the participant was shown at the end: one without a partner has another than the usual one."""
    codes = (document.get("completionCode") for document in (participant.membership, participant.document))
    return next((clean(code) for code in codes if isinstance(code, str) and code), None)


def texts(link: Any) -> dict[str, str]:
    """A link's values, all as texts; nothing for what is no object."""
    if not isinstance(link, Mapping):
        return {}
    return {str(name): value if isinstance(value, str) else json.dumps(value) for name, value in link.items()}


def clean(text: str) -> str:
    """Half characters, which UTF-8 cannot hold, as the replacement character."""
    return text if text.isascii() else _SURROGATES.sub("\ufffd", text)
