"""Reads a YAML file into plain values, with the line of each for messages.

It reads only a safe part of YAML: maps, lists, texts, numbers, true and false. The file's size, its depth and its
number of values are limited; an alias counts as all the values that it repeats.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import yaml

from hippodrome.control.config import typography
from hippodrome.control.config.diagnostics import Mistake
from hippodrome.protocol.values import KeyPath, Plain, printable

LIMIT_BYTES = 256 * 1024
LIMIT_DEPTH = 16
LIMIT_VALUES = 20_000

Value = dict[str, "Value"] | list["Value"] | str | Plain | None

_TAG = "tag:yaml.org,2002:"
_TEXT_TAGS = {_TAG + "str", _TAG + "timestamp", _TAG + "value", _TAG + "merge"}
_KNOWN_TAGS = _TEXT_TAGS | {_TAG + name for name in ("null", "bool", "int", "float", "map", "seq")}
_WHOLE = re.compile(r"[-+]?[0-9]{1,18}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,18}\.[0-9]{0,18}|\.[0-9]{1,18})(e[-+][0-9]{1,2})?", re.IGNORECASE)
_SURROGATE = re.compile("[\ud800-\udfff]")
_TRUE = {"true", "yes", "on", "y"}
_WIDE_BOMS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE)

_NO_SPACE = re.compile(r"\s*(?:- +)?(?P<key>[\w-]+):(?P<value>[^\s:/].*)")
"""`key:value`, which YAML reads as a text."""
_MATCHED_BY = re.compile(r"\s*matching: +(?P<how>same|different): +(?P<field>[^\s{}#][^{}#]*?)\s*(?:#|$)")
"""`matching: same: language`, which lacks the braces of a map in one line."""
_ENDED = re.compile(r"""\s*(?:- +)?[\w-]+: +(?P<read>"[^"]*"|'[^']*'|\{[^{}]*\})\s*""")
"""A text in quotes or a map in braces, after which the line does not end."""
_NOT_ENDED = {
    '"': 'inside of "…" write \\" for a quotation mark',
    "'": 'put a text with an apostrophe into "…"',
    "{": 'put a text that begins with { into "…"',
}


class UnreadableConfig(Exception):
    """The file cannot be read at all. `str()` says why and what to do; `line` is the line of the mistake, or None."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message)
        self.line = line


@dataclass(slots=True)
class ParsedFile:
    """A YAML file: its values, the line of each path of keys (lines count from 1), and the mistakes in its YAML."""

    values: dict[str, Value] = field(default_factory=dict)
    lines: dict[KeyPath, int] = field(default_factory=dict)
    mistakes: list[Mistake] = field(default_factory=list)

    def line(self, path: KeyPath) -> int:
        """Return the line of `path`, or of the nearest section around it that is in the file; 1 if there is none."""
        for end in range(len(path), 0, -1):
            if path[:end] in self.lines:
                return self.lines[path[:end]]
        return 1


def parse_yaml(data: bytes) -> ParsedFile:
    """Return the file's content; its `mistakes` are those in single values.

    Raises UnreadableConfig if the file cannot be read at all.
    """
    text = _decode(data)
    root = _compose(text)
    if root is None:
        raise UnreadableConfig("the file is empty; it needs the sections project and trial")
    if not isinstance(root, yaml.MappingNode):
        raise UnreadableConfig('the file must be a map that begins with "project:"', root.start_mark.line + 1)
    return _Reader().read(root)


def _decode(data: bytes) -> str:
    if len(data) > LIMIT_BYTES:
        raise UnreadableConfig(f"the file is larger than {LIMIT_BYTES // 1024} KB, which no project needs")
    if data.startswith(_WIDE_BOMS):
        raise UnreadableConfig("the file is UTF-16 or UTF-32 text; save it as UTF-8", 1)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise UnreadableConfig("the file is not UTF-8 text from here on; save it as UTF-8", line) from None


def _compose(text: str) -> yaml.Node | None:
    try:
        loader = yaml.SafeLoader(text)
        try:
            root = loader.get_single_node()
            _check_text(root)
            return root
        finally:
            loader.dispose()
    except yaml.reader.ReaderError as error:
        line = text[: int(error.position)].count("\n") + 1
        raise UnreadableConfig("an invisible control character that YAML does not allow; delete it", line) from None
    except yaml.MarkedYAMLError as error:
        raise _of_typography(error, text.splitlines()) or _syntax(error, text) from None
    except yaml.YAMLError:
        raise UnreadableConfig("the file is not valid YAML") from None
    except RecursionError:
        raise UnreadableConfig("the sections are nested too deeply") from None
    except (ValueError, OverflowError):  # an escape such as "\U99999999" or a %YAML line with a huge number
        raise UnreadableConfig("a number or an escape that YAML cannot read") from None


def _check_text(root: yaml.Node | None) -> None:
    """Raise UnreadableConfig for a text that YAML reads and nobody can mean.

    It is an escape such as "\\ud83d", half of a surrogate pair, which UTF-8 cannot hold; or a character of Word or
    Slack that only looks like one of YAML's (`typography.py`).
    """
    visited: set[int] = set()  # aliases stand for the same node
    nodes = [root] if root else []
    while nodes:
        node = nodes.pop()
        if id(node) in visited:
            continue
        visited.add(id(node))
        if isinstance(node, yaml.ScalarNode) and _SURROGATE.search(node.value):
            message = "an escape of half a character; write the character itself instead, such as 😀"
            raise UnreadableConfig(message, node.start_mark.line + 1)
        if isinstance(node, yaml.ScalarNode) and node.style is None and (message := typography.in_value(node.value)):
            raise UnreadableConfig(message, node.start_mark.line + 1)
        if isinstance(node, yaml.SequenceNode):
            nodes += reversed(node.value)
        elif isinstance(node, yaml.MappingNode):
            for key, value in reversed(node.value):
                nodes += [value, key]
                _check_pair(key, value)


def _check_pair(key: yaml.Node, value: yaml.Node) -> None:
    if isinstance(key, yaml.ScalarNode) and key.style is None and (message := typography.in_key(key.value)):
        raise UnreadableConfig(message, key.start_mark.line + 1)
    below = value.start_mark.line > key.start_mark.line
    if isinstance(value, yaml.ScalarNode) and value.style is None and below:
        message = typography.below_key(value.value)
        if message:
            raise UnreadableConfig(message, value.start_mark.line + 1)


def _of_typography(error: yaml.MarkedYAMLError, lines: list[str]) -> UnreadableConfig | None:
    """The error for a character that only looks like one of YAML's, in one of the two lines before PyYAML's error."""
    for mark in (error.problem_mark, error.context_mark):
        at = mark.line if mark else 0
        for near in range(at, max(at - 3, -1), -1):
            if near < len(lines) and (message := typography.in_line(lines[near])):
                return UnreadableConfig(message, near + 1)
    return None


def _syntax(error: yaml.MarkedYAMLError, text: str) -> UnreadableConfig:
    """PyYAML's error with its line, in plainer words for common mistakes."""
    lines = text.splitlines()
    mark = error.problem_mark or error.context_mark
    problem = error.problem or error.context or ""
    if mark is None:
        return UnreadableConfig(f"YAML cannot read this file: {problem}")
    if ("end of stream" in problem or "expected ':'" in problem) and error.context_mark is not None:
        mark = error.context_mark  # the beginning of the text or the key, not the place where PyYAML stopped
        problem = f"{error.context}, {problem}"
    number = mark.line
    source = lines[number] if number < len(lines) else ""
    if _has_tab(source):
        return UnreadableConfig("the line is indented with a tab; YAML wants spaces", number + 1)
    if "mapping values are not allowed" in problem:
        for near in (number, number - 1):
            match = _NO_SPACE.fullmatch(lines[near]) if 0 <= near < len(lines) else None
            if match:
                better = printable(f"{match['key']}: {match['value']}")
                return UnreadableConfig(f'the space after the colon is missing; write "{better}"', near + 1)
        matched = _MATCHED_BY.match(source)
        if matched:
            better = printable(f"matching: {{{matched['how']}: {matched['field']}}}")
            return UnreadableConfig(f'an unexpected colon; write "{better}"', number + 1)
        message = "an unexpected colon; check the indentation, put text with a colon in quotes"
        return UnreadableConfig(message, number + 1)
    ended = _ENDED.fullmatch(source[: mark.column]) if "expected <block end>" in problem else None
    if ended:
        rest = printable(source[mark.column :].strip())
        return UnreadableConfig(f"the value ends before {rest}; {_NOT_ENDED[ended['read'][0]]}", number + 1)
    if "expected <block end>" in problem and "<scalar>" not in problem:
        message = "the indentation does not match the lines above; a section's keys start in one column"
        return UnreadableConfig(message, number + 1)
    message = "in braces put the whole rule into '…', or write answers.consent.agree"
    if 'answers["' not in source:
        where = f'"{printable(source.strip())}", column {mark.column + 1}: {printable(problem)}'
        message = f"YAML cannot read {where}; check quotes, brackets and indentation"
    return UnreadableConfig(message, number + 1)


def _has_tab(line: str) -> bool:
    """Whether the line is indented with a tab, or has a tab after the dash of a list's item."""
    text = line.lstrip()
    return "\t" in line[: len(line) - len(text)] or text.startswith("-\t")


class _Reader:
    """Turns composed nodes into values, at most LIMIT_VALUES."""

    def __init__(self) -> None:
        self.file = ParsedFile()
        self.left = LIMIT_VALUES

    def read(self, root: yaml.MappingNode) -> ParsedFile:
        self.file.values = self._map(root, ())
        return self.file

    def _value(self, node: yaml.Node, path: KeyPath) -> Value:
        self.left -= 1
        if self.left < 0:
            raise UnreadableConfig("the file holds too many values; do not repeat large parts with aliases (*name)")
        if len(path) > LIMIT_DEPTH:
            raise UnreadableConfig("the sections are nested too deeply", node.start_mark.line + 1)
        if isinstance(node, yaml.MappingNode):
            return self._map(node, path)
        if isinstance(node, yaml.SequenceNode):
            return self._list(node, path)
        return _scalar(node)

    def _allowed(self, node: yaml.Node, path: KeyPath) -> bool:
        if node.tag not in _KNOWN_TAGS:
            self._mistake(path, node, "tags (! and !!) are not allowed; write the plain value, in quotes if it has a !")
        return node.tag in _KNOWN_TAGS

    def _list(self, node: yaml.SequenceNode, path: KeyPath) -> list[Value]:
        items: list[Value] = []
        for index, item in enumerate(node.value):
            here = (*path, index)
            self.file.lines[here] = item.start_mark.line + 1
            items.append(self._value(item, here) if self._allowed(item, here) else None)
        return items

    def _map(self, node: yaml.MappingNode, path: KeyPath) -> dict[str, Value]:
        values: dict[str, Value] = {}
        for key, value in self._pairs(node, path):
            here = (*path, key.value)
            if here in self.file.lines:
                first = self.file.lines[here]
                self._mistake(here, key, f"given twice (first on line {first}); keep one")
                continue
            self.file.lines[here] = key.start_mark.line + 1
            if self._allowed(value, here):
                values[key.value] = self._value(value, here)
        return values

    def _pairs(self, node: yaml.MappingNode, path: KeyPath) -> Iterator[tuple[yaml.ScalarNode, yaml.Node]]:
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._mistake(path, key, "a key must be a plain word or number, not a list or a map")
            elif key.tag == _TAG + "merge":
                self._mistake(path, key, "<< is not allowed; write the keys out")
            else:
                yield key, value

    def _mistake(self, path: KeyPath, node: yaml.Node, message: str) -> None:
        self.file.mistakes.append(Mistake(path, message, node.start_mark.line + 1))


def _scalar(node: yaml.Node) -> str | Plain | None:
    """The value of a scalar as YAML reads it, except that 010 is ten, and that 1:30, 0x1F and 1_000 stay texts."""
    text = str(node.value)
    if node.tag == _TAG + "null":
        return None
    if node.tag == _TAG + "bool":
        return Plain(text.lower() in _TRUE, text)
    if node.tag == _TAG + "int" and _WHOLE.fullmatch(text):
        return Plain(int(text), text)
    if node.tag == _TAG + "float" and _DECIMAL.fullmatch(text):
        return Plain(float(text), text)
    return text
