"""Characters that a word processor or a chat puts in the place of YAML's own get a sentence, with their line."""

from __future__ import annotations

import pytest

from hippodrome.control.config.yaml_file import UnreadableConfig, parse_yaml

SPACE = "an invisible character stands here, U+00A0 (no-break space); delete it, or write a plain space"
ZERO = "an invisible character stands here, U+200B (zero width space); delete it, or write a plain space"
WIDE = "an invisible character stands here, U+3000 (ideographic space); delete it, or write a plain space"
BOM = "an invisible character stands here, U+FEFF (zero width no-break space); delete it, or write a plain space"
QUOTES = 'curly quotes do not quote; write "x", or "{}" if they belong to the text'
DASH = 'an item of a list begins with a plain hyphen, "- ", not with {}'
COLON = "the colon after id is a wide one, \uff1a; write : and a space"


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("project:\n\u00a0\u00a0id: x\n  name: y", 2, SPACE),
        ("project:\n  id: x\n \u00a0name: y\n  researcher: z", 3, SPACE),
        ("project:\n  id:\u00a0x\n  name: y", 2, SPACE),
        ("project:\n  name: y\n  id:\u00a0x", 3, SPACE),
        ("project:\n  id\u00a0: x", 2, SPACE),
        ("project:\n  id: x\u00a0", 2, SPACE),
        ("project:\n  id: x\u00a0# my study", 2, SPACE),
        ("project:\n  allowedHosts:\n    -\u00a0a\n    - b", 3, SPACE),
        ("project:\n  \u200bid: x", 2, ZERO),
        ("project:\n  id: \u200bx", 2, ZERO),
        ("project:\n\u3000\u3000id: x", 2, WIDE),
        ("project:\n  id: x\n\ufeff  name: y", 3, BOM),
        ("project:\n  name: \u201cx\u201d", 2, QUOTES.format("\u201cx\u201d")),
        ("project:\n  name: \u201ex\u201c", 2, QUOTES.format("\u201ex\u201c")),
        ("project:\n  name: \u2018x\u2019", 2, QUOTES.format("\u2018x\u2019")),
        ('project:\n  name: \u201cx"', 2, 'curly quotes do not quote; write "x"'),
        ("project:\n  steps: {\u201cx\u201d: a}", 2, QUOTES.format("\u201cx\u201d")),
        ("project:\n  name: \u201ca: b\u201d", 2, 'curly quotes do not quote; write straight ones: "…"'),
        ("project:\n  allowedHosts:\n    \u2013 a\n    \u2013 b", 3, DASH.format("\u2013")),
        ("project:\n  allowedHosts:\n    \u2022 a\n  id: b", 3, DASH.format("\u2022")),
        ("project:\n  id\uff1a x\n  name: y", 2, COLON),
        ("project:\n  id\uff1ax", 2, COLON),
    ],
)
def test_a_character_that_only_looks_like_yamls_is_named_with_its_line(text: str, line: int, said: str) -> None:
    with pytest.raises(UnreadableConfig) as caught:
        parse_yaml(text.encode())
    assert (caught.value.line, str(caught.value)) == (line, said)


@pytest.mark.parametrize(
    "text",
    [
        "My\u00a0study",
        "\u00c9tude\u00a0; le pi\u00e8ge",
        "Press the key \u201cx\u201d",
        "\u201cTrust\u201d and \u201cdoubt\u201d, a study",
        "Ada\u2019s study",
        "\u2013 x",
        "\u8bf4\u660e\uff1a\u7ee7\u7eed",
        "Note\uff1a x",
        '"\u201cx\u201d"',
        "'\u00a0x'",
        "|\n    \u00a0x\n    \u2013 y",
        "\U0001f469\u200d\U0001f680",
    ],
)
def test_a_text_may_hold_any_of_them(text: str) -> None:
    assert parse_yaml(f"project:\n  name: {text}\n".encode()).mistakes == []
