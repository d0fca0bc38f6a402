"""Replaces a participant's identities in data that are shared: in texts, and in JSON."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from hippodrome.export.state import ExportedParticipant

SHORTEST = 6  # characters; a shorter identity would be found in too many texts by chance
_SURROGATES = re.compile("[\ud800-\udfff]")


class Scrub:
    """Replaces identities at any place in a text, in upper and lower case. `found` counts the replacements."""

    def __init__(self, identities: Mapping[str, str]) -> None:
        """`identities` maps each identity to its replacement. Those shorter than SHORTEST are not replaced."""
        self.found = 0
        self._replacements: dict[str, str] = {}
        for identity, replacement in identities.items():
            if len(identity) >= SHORTEST:
                for form in (identity, json.dumps(identity)[1:-1], json.dumps(identity, ensure_ascii=False)[1:-1]):
                    self._replacements.setdefault(form, replacement)
                    self._replacements.setdefault(form.lower(), replacement)
        longest_first = sorted(self._replacements, key=len, reverse=True)
        self._pattern = re.compile("|".join(map(re.escape, longest_first)), re.IGNORECASE) if longest_first else None

    def text(self, text: str) -> str:
        """Return the text without identities, and without unpaired surrogates (`clean`)."""
        return clean(self._pattern.sub(self._replace, text) if self._pattern else text)

    def value(self, value: Any) -> Any:
        """Return a JSON value with `text` applied to each of its texts and keys."""
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, Mapping):
            return {self.text(str(key)): self.value(item) for key, item in value.items()}
        if isinstance(value, list):
            return [self.value(item) for item in value]
        return value

    def _replace(self, found: re.Match[str]) -> str:
        self.found += 1
        return self._replacements.get(found[0]) or self._replacements.get(found[0].lower(), "(id)")


def identities(participant: ExportedParticipant) -> dict[str, str]:
    """Return the texts that identify a participant, each with its replacement: the id, the values of the link, and the
    completion codes."""
    found = {value: f"({name})" for name, value in texts(participant.document.get("link")).items()}
    found |= dict.fromkeys(_codes(participant), "(completionCode)")
    return {**found, participant.user: participant.number}


def completion_code(participant: ExportedParticipant) -> str | None:
    """Return the completion code that the participant was shown."""
    return next((clean(code) for code in _codes(participant)), None)


def _codes(participant: ExportedParticipant) -> list[str]:
    """The codes of a participant, first the one that they were shown: that of a game that failed comes before that of
    an unmatched participant, in `session.json`, and this before that in `participant.json`."""
    documents = (document.get("completionCode") for document in (participant.membership, participant.document))
    return [code for code in (participant.failed_code, *documents) if isinstance(code, str) and code]


def texts(link: Any) -> dict[str, str]:
    """Return the values of a link as texts; {} if `link` is no object."""
    if not isinstance(link, Mapping):
        return {}
    return {str(name): value if isinstance(value, str) else json.dumps(value) for name, value in link.items()}


def columns(document: Mapping[str, Any]) -> dict[str, str]:
    """Return the values of a participant's link and headers, by the names of their columns."""
    return {
        f"{kind}.{name}": value
        for kind, field in (("link", "link"), ("header", "headers"))
        for name, value in texts(document.get(field)).items()
    }


def clean(text: str) -> str:
    """Return the text with the replacement character for each unpaired surrogate, which UTF-8 cannot hold."""
    return text if text.isascii() else _SURROGATES.sub("\ufffd", text)
