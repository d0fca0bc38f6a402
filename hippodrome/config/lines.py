"""Reads YAML into plain values and remembers the line of each: what a good message needs.

Only the safe core of YAML is read: maps, lists, text, numbers, true/false. A file can neither be large, nor deep, nor
grow by its aliases.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass, field

import yaml

from hippodrome.config.problems import Keys
from protocol.values import Plain

LIMIT_BYTES = 256 * 1024
LIMIT_DEPTH = 16
LIMIT_VALUES = 20_000

Tree = dict[str, "Tree"] | list["Tree"] | str | Plain | None

_TAG = "tag:yaml.org,2002:"
_TEXT_TAGS = {_TAG + "str", _TAG + "timestamp", _TAG + "value", _TAG + "merge"}
_KNOWN_TAGS = _TEXT_TAGS | {_TAG + name for name in ("null", "bool", "int", "float", "map", "seq")}
_WHOLE = re.compile(r"[-+]?[0-9]{1,18}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,18}\.[0-9]{0,18}|\.[0-9]{1,18})(e[-+][0-9]{1,2})?", re.IGNORECASE)
_TRUE = {"true", "yes", "on", "y"}
_WIDE_BOMS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE, codecs.BOM_UTF32_BE)

_SYNTAX = (
    ("mapping values are not allowed", "an unexpected colon; check the indentation, put text with a colon in quotes"),
    ("could not find expected ':'", 'a key without its colon; write "key: value"'),
    ("expected <block end>", "the indentation does not match the lines above; a section's keys start in one column"),
    ("did not find expected", "the indentation or a bracket does not match the lines above"),
    ("expected ',' or", "a list or map in brackets that is not closed, or lacks a comma"),
    ("while scanning a quoted scalar", "a quotation mark that is not closed"),
    ("undefined alias", "*name refers to an anchor (&name) that is not there; put text that begins with * in quotes"),
    ("while scanning an alias", "text that begins with * must be in quotes"),
    ("while scanning an anchor", "text that begins with & must be in quotes"),
    ("duplicate anchor", "the same anchor (&name) stands twice"),
    ("cannot start any token", "text that begins with a special character (such as @, ` or %) must be in quotes"),
    ("expected a single document", 'a second document begins here ("---"); keep only one'),
    ("sequence entries are not allowed", 'a list item ("- ") in the wrong place; start it on a line of its own'),
    ("unknown escape character", "an unknown \\ sequence; use single quotes for text with backslashes"),
    ("could not determine a constructor", "tags (!name) are not allowed"),
)


@dataclass(frozen=True, slots=True)
class Mistake:
    """Something wrong with the YAML itself: where it stands (a path of keys), its line, what to do."""

    path: Keys
    line: int
    message: str


class NotYaml(Exception):
    """The text could not be read at all. `line` is where, or None; str() says why, in a sentence."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message)
        self.line = line


@dataclass(slots=True)
class Document:
    """A YAML file as plain values: `tree`, the line of each path (keys count from 1), and what was wrong on the way."""

    tree: dict[str, Tree] = field(default_factory=dict)
    lines: dict[Keys, int] = field(default_factory=dict)
    mistakes: list[Mistake] = field(default_factory=list)

    def line(self, path: Keys) -> int:
        """The line of `path`, or of the nearest section around it that is in the file."""
        for end in range(len(path), 0, -1):
            if path[:end] in self.lines:
                return self.lines[path[:end]]
        return 1


def read_yaml(data: bytes) -> Document:
    """The document in `data`; lesser mistakes are in its `.mistakes`. Raises NotYaml when nothing can be read."""
    text = _decode(data)
    root = _compose(text)
    if root is None:
        raise NotYaml("the file is empty; it needs the sections project and trial")
    if not isinstance(root, yaml.MappingNode):
        raise NotYaml('the file must be a map that begins with "project:"', root.start_mark.line + 1)
    return _Reader().read(root)


def _decode(data: bytes) -> str:
    if len(data) > LIMIT_BYTES:
        raise NotYaml(f"the file is larger than {LIMIT_BYTES // 1024} KB, which no project needs")
    if data.startswith(_WIDE_BOMS):
        raise NotYaml("the file is UTF-16 or UTF-32 text; save it as UTF-8", 1)
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data[: error.start].count(b"\n") + 1
        raise NotYaml("the file is not UTF-8 text from here on; save it as UTF-8", line) from None


def _compose(text: str) -> yaml.Node | None:
    try:
        loader = yaml.SafeLoader(text)
        try:
            return loader.get_single_node()
        finally:
            loader.dispose()
    except yaml.reader.ReaderError as error:
        line = text[: int(error.position)].count("\n") + 1
        raise NotYaml("an invisible control character that YAML does not allow; delete it", line) from None
    except yaml.MarkedYAMLError as error:
        raise _syntax(error, text) from None
    except yaml.YAMLError:
        raise NotYaml("the file is not valid YAML") from None
    except RecursionError:
        raise NotYaml("the sections are nested too deeply") from None
    except (ValueError, OverflowError):  # an escape such as "\U99999999" or a %YAML line with a huge number
        raise NotYaml("a number or an escape that YAML cannot read") from None


def _syntax(error: yaml.MarkedYAMLError, text: str) -> NotYaml:
    mark = error.problem_mark or error.context_mark
    said = f"{error.context or ''} {error.problem or ''}"
    if mark is None:
        return NotYaml("the file is not valid YAML")
    if _tab_at(text, mark.line):
        return NotYaml("the line is indented with a tab; YAML wants spaces", mark.line + 1)
    if "end of stream" in said and error.context_mark is not None:
        mark = error.context_mark  # where the quotation began, not where the file ran out
    message = next((ours for theirs, ours in _SYNTAX if theirs in said), "not valid YAML; check quotes and indentation")
    return NotYaml(message, mark.line + 1)


def _tab_at(text: str, line: int) -> bool:
    lines = text.splitlines()
    if line >= len(lines):
        return False
    indent = lines[line][: len(lines[line]) - len(lines[line].lstrip())]
    return "\t" in indent or lines[line].lstrip().startswith("-\t")


class _Reader:
    """Turns composed nodes into values, with a limit on how many there may be (aliases repeat what they name)."""

    def __init__(self) -> None:
        self.document = Document()
        self.left = LIMIT_VALUES

    def read(self, root: yaml.MappingNode) -> Document:
        self.document.tree = self._map(root, ())
        return self.document

    def _value(self, node: yaml.Node, path: Keys) -> Tree:
        self.left -= 1
        if self.left < 0:
            raise NotYaml("the file holds too many values; do not repeat large parts with aliases (*name)")
        if len(path) > LIMIT_DEPTH:
            raise NotYaml("the sections are nested too deeply", node.start_mark.line + 1)
        if isinstance(node, yaml.MappingNode):
            return self._map(node, path)
        if isinstance(node, yaml.SequenceNode):
            return self._list(node, path)
        return _scalar(node)

    def _allowed(self, node: yaml.Node, path: Keys) -> bool:
        if node.tag not in _KNOWN_TAGS:
            self._mistake(path, node, "tags (! and !!) are not allowed; write the plain value, in quotes if it has a !")
        return node.tag in _KNOWN_TAGS

    def _list(self, node: yaml.SequenceNode, path: Keys) -> list[Tree]:
        items: list[Tree] = []
        for index, item in enumerate(node.value):
            here = (*path, index)
            self.document.lines[here] = item.start_mark.line + 1
            items.append(self._value(item, here) if self._allowed(item, here) else None)
        return items

    def _map(self, node: yaml.MappingNode, path: Keys) -> dict[str, Tree]:
        values: dict[str, Tree] = {}
        for key, value in self._pairs(node, path):
            here = (*path, key.value)
            if here in self.document.lines:
                first = self.document.lines[here]
                self._mistake(here, key, f"given twice (first on line {first}); keep one")
                continue
            self.document.lines[here] = key.start_mark.line + 1
            if self._allowed(value, here):
                values[key.value] = self._value(value, here)
        return values

    def _pairs(self, node: yaml.MappingNode, path: Keys) -> Iterator[tuple[yaml.ScalarNode, yaml.Node]]:
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._mistake(path, key, "a key must be a plain word or number, not a list or a map")
            elif key.tag == _TAG + "merge":
                self._mistake(path, key, "<< is not allowed; write the keys out")
            else:
                yield key, value

    def _mistake(self, path: Keys, node: yaml.Node, message: str) -> None:
        self.document.mistakes.append(Mistake(path, node.start_mark.line + 1, message))


def _scalar(node: yaml.Node) -> str | Plain | None:
    """YAML's own reading of a plain scalar, without its surprises: 010 is ten; 1:30, 0x1F and 1_000 stay text."""
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
