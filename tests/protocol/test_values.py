"""Checks of single values of config.yml: what each accepts, and what it says of the others."""

from __future__ import annotations

import math
from typing import Any

import pytest

from hippodrome.protocol import values
from hippodrome.protocol.values import Check, Plain

NAME, YES, ONE = Plain(1, "01"), Plain(True, "yes"), Plain(1.0, "1.0")


def refused(check: Check, value: object) -> str:
    """Return what the check says of a wrong value."""
    with pytest.raises(ValueError, match=r"\w") as raised:
        check(value)
    return str(raised.value)


@pytest.mark.parametrize(("value", "blank"), [(None, True), ("", True), (" ", False), (0, False), ([], False)])
def test_only_an_empty_text_and_nothing_are_blank(value: object, blank: bool) -> None:
    assert values.is_blank(value) is blank


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (NAME, "01"),
        ("a", '"a"'),
        ("a\nb", '"a?b"'),
        ("", "empty"),
        (None, "empty"),
        (True, "true"),
        (1.5, "1.5"),
        (10**18 - 1, "9" * 18),
        (1 - 10**18, "-" + "9" * 18),
        (10**18, "such a value"),
        ({}, "a map"),
        ([], "a list"),
        ((), "a list"),
        (b"a", "such a value"),
        ("x" * 60, f'"{"x" * 60}"'),
        ("x" * 61, f'"{"x" * 59}…"'),
    ],
)
def test_a_value_is_shown_short_and_without_invisible_characters(value: object, shown: str) -> None:
    assert values.show(value) == shown


def test_a_path_names_keys_and_counts_items_from_one() -> None:
    assert values.path_text(("trial", "actionSpace", 2)) == "trial.actionSpace item 3"
    assert values.path_text(("X", "a\tb")) == "X.a?b"
    assert values.path_text(()) == ""


def test_a_check_that_refuses_a_value_gives_a_problem_at_its_path() -> None:
    assert values.checked(values.flag, "on", ("a",)) == (True, [])
    found, problems = values.checked(values.flag, 3, ("a", 0))
    assert (found, problems) == (None, [values.SectionProblem(("a", 0), "must be true or false, not 3")])


@pytest.mark.parametrize(
    ("value", "text"), [("a", "a"), (" a b\n", "a b"), (NAME, "01"), ("x" * 500, "x" * 500), ("ä", "ä")]
)
def test_a_text_is_returned_without_spaces_around_it(value: object, text: str) -> None:
    assert values.text()(value) == text


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (3, "must be text, not 3"),
        ("", "must be text, not empty"),
        (" ", 'must be text, not " "'),
        (YES, 'must be text; YAML reads yes as true or false, so write "yes" in quotes'),
        ("a\tb", "must be text; take out its tabs, line ends and invisible characters"),
        ("a\ud800", "must be text; take out its tabs, line ends and invisible characters"),
        ("x" * 501, "must be at most 500 characters long, not 501"),
    ],
)
def test_what_is_no_text_is_refused(value: object, said: str) -> None:
    assert refused(values.text(), value) == said


def test_the_name_of_an_action_is_a_text_or_a_number() -> None:
    assert [values.action_name(value) for value in ("up", 3, NAME, "a" * 64)] == ["up", "3", "01", "a" * 64]
    for wrong in (True, 1.5, None, "a" * 65):
        refused(values.action_name, wrong)


@pytest.mark.parametrize("name", ["a", "a.html", "_a b-c.d", "a" * 100, "A1"])
def test_a_page_is_named_by_its_file_with_or_without_its_ending(name: str) -> None:
    assert values.step_file(name) == name.removesuffix(".html")


@pytest.mark.parametrize("name", ["a/b", "a\\b", "a..b", "-a", "a.", "é", "a" * 101, ""])
def test_a_name_that_is_no_file_in_the_folder_of_pages_is_refused(name: str) -> None:
    assert ("without folders" in refused(lambda text: values.step_file(str(text)), name)) is (
        "/" in name or "\\" in name
    )


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (3, 3),
        (1.5, 1.5),
        (ONE, 1.0),
        (YES, None),
        (True, None),
        ("30", 30),
        (" -3 ", -3),
        ("+.5", 0.5),
        ("5.", 5.0),
        ("1e3", None),
        ("9" * 18, 10**18 - 1),
        ("9" * 19, None),
        ("x", None),
        ("", None),
        (None, None),
        ([], None),
        (math.inf, None),
        (math.nan, None),
        (10**400, 10**400),
    ],
)
def test_a_number_is_read_from_a_number_or_its_text(value: object, number: float | None) -> None:
    found = values.number_in(value)
    assert (found, type(found)) == (number, type(number))


def test_a_whole_number_lies_between_its_bounds_or_on_them() -> None:
    found = [values.whole(1, 3)(value) for value in (1, 3, "2", 2.0, NAME)]
    assert (found, {type(each) for each in found}) == ([1, 3, 2, 2, 1], {int})
    for wrong in (0, 4, 1.5, "x", True):
        assert refused(values.whole(1, 3), wrong).startswith("must be a whole number from 1 to 3, not ")


def test_a_number_lies_between_its_bounds_or_on_them() -> None:
    found: list[Any] = [values.number(0.5, 3)(value) for value in (0.5, 3, "2.5", 3.0)]
    assert (found, [type(each) for each in found]) == ([0.5, 3, 2.5, 3], [float, int, float, int])
    for wrong in (0.4, 3.1, 4, "x", True):
        assert refused(values.number(0.5, 3), wrong).startswith("must be a number from 0.5 to 3, not ")


def test_yes_and_no_may_be_written_in_several_ways() -> None:
    assert all(values.flag(value) is True for value in (True, YES, "true", "Yes", " ON "))
    assert all(values.flag(value) is False for value in (False, Plain(False, "no"), "false", "No", "off"))
    for wrong in (1, NAME, Plain(0, "0"), "maybe", "", None):
        assert refused(values.flag, wrong).startswith("must be true or false, not ")


def test_one_of_some_words_is_one_of_them() -> None:
    check = values.one_of("a", "b")
    assert [check("a"), check(" b ")] == ["a", "b"]
    assert [refused(check, wrong) for wrong in ("c", 3)] == ['must be a or b, not "c"', "must be a or b, not 3"]


def test_a_list_has_a_limit_and_may_be_a_single_text_where_that_is_allowed() -> None:
    check = values.items("action", 2)
    assert (check(["a", "b"]), check(("a",)), check([])) == (["a", "b"], ["a"], [])
    assert refused(check, ["a", "b", "c"]) == "must have at most 2 items, not 3"
    assert [refused(check, wrong) for wrong in ("a", NAME, {})] == [
        f"must be a list: a line with a dash for each action, not {shown}" for shown in ('"a"', "01", "a map")
    ]
    single = values.items("action", 2, single=True)
    assert (single("a"), single(NAME), single(["a"])) == (["a"], [NAME], ["a"])
    refused(single, 3)


def test_a_section_is_a_map() -> None:
    assert values.section("a: 1")({"a": 2}) == {"a": 2}
    assert refused(values.section("a: 1"), []) == (
        'must be a section: indented lines such as "a: 1" below it, not a list'
    )


# Options, which become JSON


def nested(levels: int, kind: type) -> Any:
    """Return a map with so many maps or lists in each other, the map itself included."""
    value: Any = 1
    for _ in range(levels - 1):
        value = {"a": value} if kind is dict else [value]
    return {"a": value}


def test_options_are_json_values_as_they_were_written() -> None:
    given = {"a": [1, 1.5, None, True, "é"], NAME: {"b": YES}, 7: -(2**63) + 1, "d": 2**63 - 1}
    assert values.options(given) == {
        "a": [1, 1.5, None, True, "é"],
        "1": {"b": True},
        "7": -(2**63) + 1,
        "d": 2**63 - 1,
    }


@pytest.mark.parametrize("wrong", [2**63, -(2**63), math.nan, math.inf, "\ud800", b"a", (1,)])
def test_options_that_json_cannot_hold_are_refused(wrong: object) -> None:
    assert "one of the values is none of these" in refused(values.options, {"a": [{"b": wrong}]})
    assert refused(values.options, [wrong]).startswith("must be a map")


@pytest.mark.parametrize("kind", [dict, list])
def test_options_are_nested_at_most_eight_deep(kind: type) -> None:
    assert values.options(nested(8, kind)) == nested(8, kind)
    assert refused(values.options, nested(9, kind)) == "must be nested no more than 8 deep"


def test_options_are_at_most_4096_characters_of_json_without_spaces() -> None:
    fitting = {"a": [1, 2], "b": "x" * (4096 - len('{"a":[1,2],"b":""}'))}
    assert values.options(fitting) == fitting
    assert "not 4097" in refused(values.options, {**fitting, "b": fitting["b"] + "x"})  # type: ignore[operator]
