"""Replaces a participant's identities in data that are shared: in texts, and in JSON.

Participants, or who sends them the link, choose their id and the values of the link. So these may be words of the
format, such as `rewards` or `player_0`. To keep the data whole, only whole words in values are replaced, never a key.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping
from typing import Any

SHORTEST = 6  # characters; a shorter identity would be found in too many texts by chance
OWN_FIELDS = frozenset(
    {
        "kind",
        "player",
        "by",
        "to",
        "toAct",
        "standIns",
        "callback",
        "name",
        "what",
        "why",
        "limit",
        "outcomes",
        "command",
        "event",
        "action",
        "key",
        "page",
        "actionName",
        "time",
        "hash",
        "path",
        "model",
        "method",
    }
)
"""Fields of a recording's lines, of messages in them, and of a tape's records, with words of the format or of the study
alone: no participant writes a sentence there."""
_ARRAY = {"dtype", "shape", "zlib"}  # the keys of a recorded array
# In a text that holds JSON, \n before a word looks like a letter.
_BEGIN = r"(?:(?<![A-Za-z0-9_-])|(?<=\\[bfnrt]))"
_END = r"(?![A-Za-z0-9_-])"
_SURROGATES = re.compile("[\ud800-\udfff]")


class Scrub:
    """Replaces identities that are whole words of a text, in upper and lower case. `found` counts the replacements."""

    def __init__(self, identities: Mapping[str, str], servers: Mapping[str, str] | None = None) -> None:
        """`identities` maps each identity to its replacement. Those shorter than SHORTEST are not replaced.

        `servers` does so with names of servers, which are replaced also within a word.
        """
        self.found = 0
        self._given = identities, servers or {}
        self._replacements: dict[str, str] = {}
        patterns = self._any_of(servers or {}), self._any_of(identities)
        parts = (patterns[0], patterns[1] and f"{_BEGIN}{patterns[1]}{_END}")
        self._pattern = re.compile("|".join(filter(None, parts)), re.IGNORECASE) if any(parts) else None

    def _any_of(self, identities: Mapping[str, str]) -> str:
        """The pattern of any of these, the longest first; "" of none."""
        forms: dict[str, str] = {}
        for identity, replacement in identities.items():
            if len(identity) >= SHORTEST:
                for form in (identity, json.dumps(identity)[1:-1], json.dumps(identity, ensure_ascii=False)[1:-1]):
                    forms.setdefault(form, replacement)
                    forms.setdefault(form.lower(), replacement)
        self._replacements |= forms
        return f"(?:{'|'.join(map(re.escape, sorted(forms, key=len, reverse=True)))})" if forms else ""

    def sparing(self, players: Collection[str]) -> Scrub:
        """Return one that does not replace the names of these players: their game cannot be read without them."""
        names = {player.lower() for player in players}
        identities, servers = self._given
        kept = {identity: replacement for identity, replacement in identities.items() if identity.lower() not in names}
        return Scrub(kept, servers)

    def text(self, text: str) -> str:
        """Return the text without identities, and without unpaired surrogates (`clean`)."""
        return clean(self._pattern.sub(self._replace, text) if self._pattern else text)

    def value(self, value: Any) -> Any:
        """Return a JSON value with `text` applied to each of its texts. Keys and recorded arrays stay."""
        if isinstance(value, str):
            return self.text(value)
        if isinstance(value, Mapping):
            if value.keys() == _ARRAY:
                return value
            return {clean(str(key)): self.value(item) for key, item in value.items()}
        if isinstance(value, list):
            return [self.value(item) for item in value]
        return value

    def record(self, record: Mapping[str, Any]) -> dict[str, Any]:
        """Return a recording's line, or a tape's record, with `value` applied to all fields but OWN_FIELDS."""
        if self._pattern is None:
            return dict(record)
        return {name: self._field(name, value) for name, value in record.items()}

    def _field(self, name: str, value: Any) -> Any:
        if name in OWN_FIELDS:
            return value
        if name == "form" and isinstance(value, Mapping):
            return self.record(value)
        if name == "players" and isinstance(value, Mapping):
            return {player: self._part(part) for player, part in value.items()}
        if name == "messages" and isinstance(value, list):
            return [self._part(message) for message in value]
        return self.value(value)

    def _part(self, part: Any) -> Any:
        return self.record(part) if isinstance(part, Mapping) else self.value(part)

    def _replace(self, found: re.Match[str]) -> str:
        self.found += 1
        return self._replacements.get(found[0]) or self._replacements.get(found[0].lower(), "(id)")


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
