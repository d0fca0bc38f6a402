"""Finds what a word processor or a chat has put in the place of YAML's own characters, such as curly quotes. Pure.

A text may hold any of them. They are mistakes only where YAML would have taken the plain character for its own.
"""

from __future__ import annotations

import re
import unicodedata

_ODD = "\u00a0\u00ad\u1680\u2000-\u200d\u202f\u205f\u2060\u3000\ufeff"
_INVISIBLE = re.compile(f"[{_ODD}]")
_AROUND_WORD = re.compile(rf"[{_ODD}]\S*|-[{_ODD}].*|\S*[{_ODD}]|.*[{_ODD}]#.*", re.DOTALL)
_IN_LINE = re.compile(rf"\s*[{_ODD}]|\s*-[{_ODD}]|\s*(?:- +)?[\w-]+(?:[{_ODD}]+:|:[{_ODD}])")
_QUOTES = "\u201c\u201d\u201e\u201f\u2018\u2019\u201a\u201b"
_QUOTED = re.compile(f"[{_QUOTES}][^\n]*[{_QUOTES}\"']")
_QUOTE_IN_LINE = re.compile(f"\\s*(?:- +)?(?:[\\w-]+: +)?[{_QUOTES}]")
_DASH = re.compile("\\s*(?P<dash>[\u2010-\u2015\u2212\u2022])\\s")
_COLON = re.compile(r"\s*(?:- +)?(?P<key>[A-Za-z][\w-]*)\s*\uff1a", re.ASCII)


def in_key(key: str) -> str:
    """Return what to say about a plain key; "" if nothing is wrong."""
    return _of_space(key) or _of_quotes(key)


def in_value(text: str) -> str:
    """Return what to say about a plain value; "" if nothing is wrong."""
    return (_of_space(text) if _AROUND_WORD.fullmatch(text) else "") or _of_quotes(text)


def below_key(text: str) -> str:
    """Return what to say about a plain value that begins in a line below its key; "" if nothing is wrong."""
    if dash := _DASH.match(text):
        return f'an item of a list begins with a plain hyphen, "- ", not with {dash["dash"]}'
    if colon := _COLON.match(text):
        return f"the colon after {colon['key']} is a wide one, \uff1a; write : and a space"
    return ""


def in_line(line: str) -> str:
    """Return what to say about a line at which, or soon after which, YAML cannot read the file; "" if nothing."""
    space = _of_space(line) if _IN_LINE.match(line) else ""
    quotes = 'curly quotes do not quote; write straight ones: "…"' if _QUOTE_IN_LINE.match(line) else ""
    return space or below_key(line) or quotes


def _of_space(text: str) -> str:
    match = _INVISIBLE.search(text)
    if match is None:
        return ""
    name = unicodedata.name(match[0]).lower()
    return f"an invisible character stands here, U+{ord(match[0]):04X} ({name}); delete it, or write a plain space"


def _of_quotes(text: str) -> str:
    if not _QUOTED.fullmatch(text):
        return ""
    keep = "" if '"' in text else f', or "{text}" if they belong to the text'
    inner = text[1:-1].replace('"', "'")
    return f'curly quotes do not quote; write "{inner}"{keep}'
