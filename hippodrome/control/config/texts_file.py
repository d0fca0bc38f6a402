"""Writes all English texts as lines of config.yml, for translators (`docs/texts.en.yml`)."""

from __future__ import annotations

import json
from collections.abc import Mapping

from hippodrome.control.model.texts import GROUPS, LANGUAGE

HEAD = """\
# What Hippodrome says to participants, in English. docs/texts.md says where these texts are seen.
# For another language copy everything from "texts:" on into your config.yml, below "project:", give the language, and
# write your own words into the quotes. A text that you remove stays English.
# A study whose participants play alone needs neither "The lobby" nor "Playing with others".
project:
  texts:
"""


def texts_file() -> str:
    """Return the content of `docs/texts.en.yml`. Its `language` is empty, so that `hippodrome check` asks for it."""
    groups = ("".join(_group(title, texts)) for title, texts in GROUPS.items())
    return HEAD + "\n".join(groups)


def _group(title: str, texts: Mapping[str, str]) -> list[str]:
    return [f"    # {title}\n", *(f"    {name}:{_value(name, text)}\n" for name, text in texts.items())]


def _value(name: str, text: str) -> str:
    return "  # of your words, such as fr" if name == LANGUAGE else f" {json.dumps(text, ensure_ascii=False)}"
