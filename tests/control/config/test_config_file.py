"""config.yml as a file: encodings, syntax, anchors."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, read_project
from tests.control.config.folder import SMALL, mistakes, only_mistake, small


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "config.yml: the file is empty; it needs the sections project and trial"),
        (b"# nothing\n", "config.yml: the file is empty; it needs the sections project and trial"),
        (b"- a\n- b\n", 'config.yml:1: the file must be a map that begins with "project:"'),
        (b"hello", 'config.yml:1: the file must be a map that begins with "project:"'),
        (b"project:\n\tid: a\n", "config.yml:2: the line is indented with a tab; YAML wants spaces"),
        (b"project:\n  id: caf\xe9\n", "config.yml:2: the file is not UTF-8 text from here on; save it as UTF-8"),
        ("project:\n".encode("utf-16"), "config.yml:1: the file is UTF-16 or UTF-32 text; save it as UTF-8"),
        (b"a: b\x07\n", "config.yml:1: an invisible control character that YAML does not allow; delete it"),
        (b"x" * 300_000, "config.yml: the file is larger than 256 KB, which no project needs"),
        (
            b"a:\n  b: 1\n c: 2\n",
            "config.yml:3: the indentation does not match the lines above; a section's keys start in one column",
        ),
        (b"a: b: c\n", "config.yml:1: an unexpected colon; check the indentation, put text with a colon in quotes"),
        (
            b"project:\n  matching: same: language # both\n",
            'config.yml:2: an unexpected colon; write "matching: {same: language}"',
        ),
        (
            b"project:\n  matching:  different:  my role\n",
            'config.yml:2: an unexpected colon; write "matching: {different: my role}"',
        ),
        (b"project:\n  id:a\n  live: true\n", 'config.yml:2: the space after the colon is missing; write "id: a"'),
        (b"steps:\n  1:consent\n  2: game\n", 'config.yml:2: the space after the colon is missing; write "1: consent"'),
        (b"a: 1\nb: 'it's'\n", """config.yml:2: the value ends before s'; put a text with an apostrophe into "…\""""),
        (
            b'a:\n  b: "say "{x}" now"\n',
            """config.yml:2: the value ends before {x}" now"; inside of "…" write \\" for a quotation mark""",
        ),
        (b"a:\n  b: {x} s\n", 'config.yml:2: the value ends before s; put a text that begins with { into "…"'),
        (b"a: " + b"[" * 5000, "config.yml: the sections are nested too deeply"),
        (
            b'project:\n  name: "a \\ud83d b"\n',
            "config.yml:2: an escape of half a character; write the character itself instead, such as 😀",
        ),
        (
            b'project:\n  texts:\n    "\\ud800": x\n',
            "config.yml:3: an escape of half a character; write the character itself instead, such as 😀",
        ),
        (b"a: " + b"{b: " * 30 + b"1" + b"}" * 30, "config.yml:1: the sections are nested too deeply"),
    ],
)
def test_a_file_that_cannot_be_read_gets_one_message(folder: Path, data: bytes, expected: str) -> None:
    assert mistakes(folder, data) == [expected]


@pytest.mark.parametrize(
    ("text", "line", "quoted"),
    [
        ('a:\n  b: "open\n  c: d\n', 2, '"b: "open"'),
        ("a: [1, 2\nb: 3\n", 2, '"b: 3"'),
        ("a: *no\n", 1, '"a: *no"'),
        ("a: @lab\n", 1, '"a: @lab"'),
        ("a: 1\n---\nb: 2\n", 2, '"---"'),
        ("a: 1\nlive\nb: 2\n", 2, '"live"'),
        ('a: "\\q"\n', 1, '"a: "\\q""'),
    ],
)
def test_other_syntax_errors_get_the_message_of_yaml(folder: Path, text: str, line: int, quoted: str) -> None:
    """The message has the line, its text and what to look at."""
    (expected,) = mistakes(folder, text)
    assert expected.startswith(f"config.yml:{line}: YAML cannot read {quoted}, column ")
    assert expected.endswith("; check quotes, brackets and indentation")


def test_anchors_that_multiply_without_limit_are_refused(folder: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    expected = "config.yml: the file holds too many values; do not repeat large parts with aliases (*name)"
    assert mistakes(folder, "\n".join(lines)) == [expected]


def test_an_anchor_within_itself_is_refused(folder: Path) -> None:
    assert mistakes(folder, "a: &a [*a]") == ["config.yml:1: the sections are nested too deeply"]


def test_a_path_that_is_no_folder_is_refused(folder: Path) -> None:
    for place, expected in (
        (folder / "nowhere", "there is no such folder"),
        (folder / "steps" / "consent.html", "this is a file; name the folder it is in"),
    ):
        with pytest.raises(ConfigErrors) as caught:
            read_project(place)
        assert str(caught.value) == f"{place}: {expected}"


def test_a_missing_file_and_two_files_are_refused(folder: Path) -> None:
    with pytest.raises(ConfigErrors) as caught:
        read_project(folder)
    assert str(caught.value) == f"config.yml: there is no such file in {folder}"
    (folder / "config.yaml").write_text(SMALL)
    assert mistakes(folder, SMALL) == ["config.yml: there is a config.yaml too; keep only one of them"]


def test_a_key_that_is_given_twice_is_refused(folder: Path) -> None:
    assert mistakes(folder, small(project="live: true\nid: other\nlive: false\n")) == [
        "config.yml:8: project.id: given twice (first on line 2); keep one",
        "config.yml:9: project.live: given twice (first on line 7); keep one",
    ]
    text = small(steps='1: consent\n"1": survey\n2: thanks\n')
    assert mistakes(folder, text) == ["config.yml:5: project.steps.1: given twice (first on line 4); keep one"]


def test_merge_keys_and_keys_that_are_no_words_are_refused(folder: Path) -> None:
    assert only_mistake(folder, small(project="<<: {live: true}\n")) == "project: << is not allowed; write the keys out"
    expected = "project: a key must be a plain word or number, not a list or a map"
    assert only_mistake(folder, small(project="? [a, b]\n: c\n")) == expected
