"""Whether words read as English: by how many of them are among those that every English text is full of."""

from __future__ import annotations

import re
from collections.abc import Iterable

COMMON = frozenset(("the", "and", "to", "you", "your", "this", "that", "are", "with"))
LEAST = 0.08
"""The share of these words that English has at least: a fifth in our examples, and hardly any in other languages."""
ENOUGH = 50
"""Words from which on the share says something."""

_NO_WORDS = re.compile(
    r"<(script|style)\b.*?</\1\s*>|<!--.*?-->|<[^>]*>|\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}|\{[a-z]+\}|&\w+;",
    re.IGNORECASE | re.DOTALL,
)
_WORD = re.compile(r"[^\W\d_]+")


def words_of(page: str) -> list[str]:
    """The words of a page's visible text, in small letters."""
    return _WORD.findall(_NO_WORDS.sub(" ", page).lower())


def share(words: list[str]) -> float:
    """The share of these words that are common English ones, from 0 to 1."""
    return sum(word in COMMON for word in words) / len(words)


def is_not_english(texts: Iterable[str]) -> bool:
    """Whether these pages and texts are certainly in another language. False if they have too few words to tell."""
    words = [word for text in texts for word in words_of(text)]
    return len(words) >= ENOUGH and share(words) < LEAST
