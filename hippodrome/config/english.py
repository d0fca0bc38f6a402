"""Tells whether a text is English, by the share of very common English words in it."""

from __future__ import annotations

import re
from collections.abc import Iterable

COMMON = frozenset(("the", "and", "to", "you", "your", "this", "that", "are", "with"))
LEAST = 0.08
"""The least share of words in COMMON that an English text has.

The share is about a fifth in Hippodrome's examples, and nearly 0 in texts of other languages.
"""
ENOUGH = 50
"""The least number of words for which the share is reliable."""

_NO_WORDS = re.compile(
    r"<(script|style)\b.*?</\1\s*>|<!--.*?-->|<[^>]*>|\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}|\{[a-z]+\}|&\w+;",
    re.IGNORECASE | re.DOTALL,
)
_WORD = re.compile(r"[^\W\d_]+")


def words_of(page: str) -> list[str]:
    """Return the words of a page's visible text, in small letters."""
    return _WORD.findall(_NO_WORDS.sub(" ", page).lower())


def share(words: list[str]) -> float:
    """Return the share of these words that are in COMMON, from 0 to 1."""
    return sum(word in COMMON for word in words) / len(words)


def is_not_english(texts: Iterable[str]) -> bool:
    """Return whether these pages and texts are certainly in another language than English.

    The result is False if they have fewer than ENOUGH words.
    """
    words = [word for text in texts for word in words_of(text)]
    return len(words) >= ENOUGH and share(words) < LEAST
