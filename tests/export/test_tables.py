"""Tables hold any answers that people send, and reading them gives the same answers."""

from __future__ import annotations

import csv
import io
import json
import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hippodrome.export.answers import MAX_LINK, Answers, LongAnswers
from hippodrome.export.keys import KeyKind, Listed, read
from hippodrome.export.records import Record, SourceFile
from hippodrome.export.scrub import Scrub, clean
from hippodrome.export.table_files import Column, Style, Table, TableFile
from hippodrome.export.tables import Identities
from hippodrome.trial.recordings.recording import line
from testing.exploration import examples
from tests.export.data_world import PROJECT, TIME, answer, participant

TEXT = st.text(st.characters(), max_size=20)  # half characters, NUL, newlines and all
HOSTILE = [
    "=1+1",
    "+49",
    "-5",
    "@SUM(A1)",
    "\t=x",
    "\r=x",
    'a"b',
    "a,b",
    "a\nb",
    "a\r\nb",
    "\0",
    "",
    " ",
    "\ud800",
    "\uff1d1",
]
VALUE = st.one_of(TEXT, st.sampled_from(HOSTILE), st.lists(TEXT, max_size=4))
ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(), st.floats(), TEXT),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=6,
)
QUICK = settings(max_examples=examples(60))


def filled(people: Mapping[str, Mapping[str, Any]], **changes: Any) -> list[Record]:
    """Make records like those that a run leaves, in their order."""
    records = []
    for user, steps in sorted(people.items()):
        files = [SourceFile("p", KeyKind.PARTICIPANT, "1", document=participant(user, **changes))]
        files += [
            SourceFile(step, KeyKind.ANSWER, "1", step, document=answer(step, sent)) for step, sent in steps.items()
        ]
        records.append(Record(user, user, user, {file.key: file for file in files}))
    return records


def seen(records: list[Record], apart: bool = False) -> Answers:
    """Return the table of answers, with its columns."""
    answers = Answers(PROJECT, apart)
    for record in records:
        if apart:
            record.without_identities()
        answers.see(record)
    return answers


def rows_of(table: Table, records: list[Record]) -> list[Any]:
    return [row for record in records for row in table.rows(record)]


def written(
    records: list[Record], folder: Path, apart: bool = False, **style: Any
) -> tuple[list[dict[str, str]], list[Any]]:
    """Write the answers, and read them back from CSV and from Parquet."""
    answers = seen(records, apart)
    sheet, parquet = write(folder / "answers", answers.columns, rows_of(answers, records), Style(**style))
    with sheet.open(encoding="utf-8-sig", newline="") as file:
        found = list(csv.DictReader(file))
    return found, pq.read_table(parquet).to_pylist()


def write(base: Path, columns: Any, rows: Any, style: Style) -> list[Path]:
    with TableFile(base, columns, style) as file:
        file.add(rows)
    return file.paths


def as_sent(typed: Any, sent: str) -> Any:
    """Return the text that a form sent for a value in Parquet, where 5 is 5.0 if another number of the column is 2.5."""
    told = "" if typed is None else str(typed)
    return sent if told == f"{sent}.0" else told


def test_columns_stand_in_the_order_of_the_study_and_of_its_pages(tmp_path: Path) -> None:
    records = filled(
        {"b": {"4": {"z": "1", "a": "2"}, "1": {"consent": "yes"}}, "a": {"old": {"x": "1"}, "4": {"z": "3"}}}
    )
    (first, second), _ = written(records, tmp_path)
    assert [name for name in first if name[0].isdigit() or name.startswith("old")] == [
        "1.consent",
        "4.z",
        "4.a",
        "old.x",
    ]
    times = [name for name in first if name.startswith("answered.")]
    assert times == [f"answered.{step}" for step in ("1", "2", "3", "4", "old")]
    assert "answered.finalStep" not in first, "its page asks nothing"
    assert (first["participant"], first["1.consent"], first["old.x"], second["1.consent"]) == ("a", "", "1", "yes")


def test_it_says_when_a_last_page_with_fields_was_answered(tmp_path: Path) -> None:
    ((first, second), _) = written(filled({"a": {"finalStep": {"remarks": "fun"}}, "b": {"1": {}}}), tmp_path)
    assert (first["finalStep.remarks"], first["answered.finalStep"] != "", second["answered.finalStep"]) == (
        "fun",
        True,
        "",
    )


@QUICK
@given(st.lists(st.dictionaries(TEXT, VALUE, max_size=5), min_size=1, max_size=4))
@example([{"a": HOSTILE, "": "empty name"}, {"a": "one"}])
@example([{"x\ud800": "1"}, {"x\ufffd": "2"}])
@example([{"a": "1\x85\u20282"}])
def test_tables_give_back_every_value_that_was_sent(people: list[dict[str, Any]]) -> None:
    records = filled({f"u{number}": {"2": given} for number, given in enumerate(people)})
    with tempfile.TemporaryDirectory() as folder:
        sheet, parquet = written(records, Path(folder))
    assert len(sheet) == len(parquet) == len(people)
    for given_, row, typed in zip(people, sheet, parquet, strict=True):
        assert set(row) == set(typed)
        names = [f"2.{clean(name)}" for name in given_]
        for name, value in given_.items():
            at = f"2.{clean(name)}"
            if names.count(at) > 1 or sum(n.partition("~")[0] == at for n in row) > 1:
                continue  # two names that UTF-8 cannot tell apart have columns of their own
            items = [clean(item) for item in ([value] if isinstance(value, str) else value)]
            assert row[at] == "; ".join(items)
            assert typed[at] == items or [as_sent(typed[at], row[at])] == items
        missing = {name for name in typed if name.startswith("2.")} - {f"2.{clean(n)}" for n in given_}
        assert all(typed[name] is None and row[name] == "" for name in missing if "~" not in name)


@QUICK
@given(st.dictionaries(st.sampled_from(["1", "2", "3", "x"]), st.dictionaries(TEXT, ANYTHING, max_size=4)), ANYTHING)
def test_answers_of_any_type_make_a_table(steps: dict[str, Any], link: Any) -> None:
    people = {"a": json.loads(json.dumps(steps)), "b": {"2": {"age": "3"}}}
    with tempfile.TemporaryDirectory() as folder:
        for apart in (False, True):
            sheet, parquet = written(filled(people, link=link), Path(folder), apart)
            assert len(sheet) == len(parquet) == 2
        records = filled(people)
        answers = seen(records)
        long = rows_of(LongAnswers(answers), records)
        write(Path(folder) / "long", LongAnswers.columns, long, Style())
        who = Identities(answers)
        write(Path(folder) / "who", who.columns, rows_of(who, records), Style())
    sent = sum(len(v) if isinstance(v, list) and all(isinstance(i, str) for i in v) else v is not None
               for given_ in steps.values() for v in given_.values())  # fmt: skip
    assert len(long) == sent + 1


@pytest.mark.parametrize(
    ("values", "kind"),
    [
        (["1", "2"], "int64"),
        (["1", "", "-20"], "int64"),
        (["1", "2.5", "-0.25", ""], "double"),
        (["", ""], "string"),
        (["1", "02"], "string"),
        (["1", "+2"], "string"),
        (["1", "1e3"], "string"),
        (["1", "2.50"], "string"),
        (["1", " 2"], "string"),
        (["1", "-0"], "string"),
        (["0.5", "-0.0"], "string"),
        (["1", "٣"], "string"),
        (["1", "nan"], "string"),
        (["1", "9007199254740993"], "string"),
        (["1", "two"], "string"),
        (["1", 2], "string"),
        (["1", ["2", "3"]], "list<element: string>"),
        ([1, 2], "int64"),
        ([1, 2.5], "double"),
        ([True, False], "bool"),
        (["a", ["b", "c"]], "list<element: string>"),
        ([1, "a"], "string"),
        ([{"a": 1}, [1]], "string"),
        ([2**70, 1], "string"),
        ([True, 1], "string"),
    ],
)
def test_a_column_has_the_narrowest_type_that_holds_its_values(tmp_path: Path, values: list[Any], kind: str) -> None:
    records = filled({f"u{number}": {"2": {"x": value}} for number, value in enumerate(values)})
    written(records, tmp_path)
    assert str(pq.read_schema(tmp_path / "answers.parquet").field("2.x").type) == kind


SENT_NUMBER = st.one_of(
    st.integers().map(str), st.floats().map(repr), st.text("0123456789.-+e ", max_size=6), st.just("")
)


@QUICK
@given(st.lists(SENT_NUMBER, min_size=1, max_size=6))
def test_a_number_that_a_form_sent_can_be_read_back_as_the_text_that_was_sent(sent: list[str]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        records = filled({f"u{number}": {"2": {"x": text}} for number, text in enumerate(sent)})
        sheet, parquet = written(records, Path(folder))
    assert [row["2.x"] for row in sheet] == sent  # CSV has what was sent, whatever its column is in Parquet
    assert [as_sent(row["2.x"], text) for row, text in zip(parquet, sent, strict=True)] == sent


def test_only_tables_for_spreadsheets_escape_formulas(tmp_path: Path) -> None:
    sent = {str(number): text for number, text in enumerate([*HOSTILE, "-5.5", "+1e3", "1-2"])}
    records = filled({"-user": {"2": sent}})
    true, _ = written(records, tmp_path)
    assert [true[0][f"2.{name}"] for name in sent] == [clean(text) for text in sent.values()]
    safe, typed = written(records, tmp_path, spreadsheet=True)
    for cell in safe[0].values():
        assert cell[:1] not in set("=+-@\t\r\0\uff1d") or cell in ("-5", "+49", "-5.5", "+1e3"), cell
    assert safe[0]["2.0"] == "'=1+1"
    assert safe[0]["participant"] == "'-user"
    assert typed[0]["2.0"] == "=1+1"  # Parquet runs nothing
    assert (tmp_path / "answers.csv").read_bytes().startswith("\ufeff".encode())


def test_the_number_of_columns_is_limited(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("hippodrome.export.answers.MAX_FIELDS", 10)
    monkeypatch.setattr("hippodrome.export.answers._MAX_COUNTED", 60)
    people = {f"u{n}": {"2": {"age": "3", "pet": "cat"}} for n in range(5)}
    people |= {f"x{n}": {"2": {f"junk-{n}-{m}": "x" for m in range(50)} | {"age": "9"}} for n in range(5)}
    link = {f"l{n}": "v" for n in range(80)}
    rows, _ = written(filled(people, link=link), tmp_path)
    assert len(rows[0]) < 10 + MAX_LINK + 15
    assert [row["2.age"] for row in rows] == ["3"] * 5 + ["9"] * 5
    assert [row["2.pet"] for row in rows] == ["cat"] * 5 + [""] * 5
    for number, row in enumerate(rows[5:]):
        rest = json.loads(row["other"])
        shown = {name: row[name] for name in row if name.startswith("2.junk") and row[name]}
        junk = {name: value for name, value in {**rest, **shown}.items() if name.startswith("2.junk")}
        assert junk == {f"2.junk-{number}-{m}": "x" for m in range(50)}
        assert sum(name.startswith("link.") for name in rest) == 80 + len(["header.user-agent"]) - MAX_LINK


def test_the_code_of_a_participant_whose_game_failed_is_the_one_that_they_saw(tmp_path: Path) -> None:
    game = {"outcome": "failed", "completionCode": "FAILED7"}

    def records() -> list[Record]:
        (record,) = filled({"user-0001": {"2": {"completionCode": "TYPED"}}})
        record.files["3"] = SourceFile("3", KeyKind.ANSWER, "1", "3", document=answer("3", game, page="game"))
        return [record]

    (row,), _ = written(records(), tmp_path)
    assert (row["completionCode"], row["3.completionCode"]) == ("FAILED7", "FAILED7")
    (hidden,), _ = written(records(), tmp_path, apart=True)
    assert "FAILED7" not in hidden.values()
    (identity,) = rows_of(Identities(seen([])), records())
    assert identity == ["user-0001", "user-0001", "FAILED7"]


@pytest.mark.parametrize("apart", [False, True])
def test_headers_are_columns_only_where_identities_are(tmp_path: Path, apart: bool) -> None:
    records = filled({"a": {}, "b": {}}, headers={"user-agent": "Firefox", "x-forwarded-for": "203.0.113.7"})
    (row, _), _ = written(records, tmp_path, apart)
    assert (row.get("header.user-agent"), "203.0.113.7" in row.values()) == (
        (None, False) if apart else ("Firefox", True)
    )
    who = Identities(seen(records))
    assert "203.0.113.7" in rows_of(who, records)[0]
    assert Column("header.x-forwarded-for") in who.columns


def test_finished_needs_every_step_but_the_last(tmp_path: Path) -> None:
    whole = {step: {"x": "1"} for step in ("1", "2", "3", "4")}
    rows, _ = written(filled({"a": whole, "b": {s: whole[s] for s in ("1", "2", "4")}, "c": {}}), tmp_path)
    assert [row["finished"] for row in rows] == ["true", "false", "false"]


# Keys


@given(st.text())
@example("ann/answers/../../x.json")
@example("ann/trials/../3-episode-0001.jsonl.gz")
@example("../../etc/passwd")
def test_hostile_keys_never_become_paths(rest: str) -> None:
    item = read("maze", Listed(f"maze/users/{rest}", "1", 1))
    for part in (item.user, item.step, item.server, item.name):
        assert "/" not in part
        assert part not in (".", "..")
    if item.kind is not KeyKind.FOREIGN:
        assert item.user


def test_every_key_that_hippodrome_writes_is_recognized() -> None:
    kinds = {
        "ann/participant.json": KeyKind.PARTICIPANT,
        "ann/answers/finalStep.json": KeyKind.ANSWER,
        "ann/trials/sabc-1/3-episode-0001.jsonl.gz": KeyKind.RECORDING,
        "ann/trials/sabc-1/3-episode-0001-2.jsonl.gz": KeyKind.RECORDING,
        "ann/trials/a-b.c/3-trial.jsonl.gz": KeyKind.RECORDING,
        "ann/trials/sabc-1/my-step-trial-2.jsonl.gz": KeyKind.RECORDING,
        "ann/answers/1.json.part": KeyKind.FOREIGN,
        "ann/participant.json/x": KeyKind.FOREIGN,
    }
    found = {rest: read("maze", Listed(f"maze/users/{rest}", "1", 1)) for rest in kinds}
    assert {rest: item.kind for rest, item in found.items()} == kinds
    assert found["ann/trials/sabc-1/my-step-trial-2.jsonl.gz"].step == "my-step"


# Identities


@QUICK
@given(st.text(min_size=6, max_size=12), TEXT, TEXT)
def test_an_identity_that_is_a_word_leaves_every_text_and_every_json(identity: str, before: str, after: str) -> None:
    hide = Scrub({identity: "N"})
    told = {"a": f"{before} {identity}\n{identity}\n{after}", identity: [identity]}
    if "N" not in identity and identity not in before + after:
        plain = hide.text(f"{before}\n{identity}\n{after}")
        assert clean(identity) not in plain.replace(clean(before), "").replace(clean(after), "")
        assert hide.value(told)[identity] == ["N"]
    for form in (json.dumps(told), json.dumps(told, ensure_ascii=False)):
        assert identity not in hide.text(form) or identity in before + after


def test_only_identifying_values_of_enough_characters_are_replaced() -> None:
    document = participant("user-0001", link={"PROLIFIC_PID": "5f2a77b1", "LANG": "en"})
    file = SourceFile("p", KeyKind.PARTICIPANT, "1", document=document)
    hide = Scrub(Record("user-0001", "p1", "p1", {"p": file}).identities)
    code = participant("user-0001")["completionCode"]
    assert (
        hide.text(f"I am 5F2A77B1, USER-0001, my code is {code}; en")
        == "I am (PROLIFIC_PID), p1, my code is (completionCode); en"
    )
    assert hide.found == 3


# Writing


def test_csv_follows_the_standard(tmp_path: Path) -> None:
    columns = [
        Column("a"),
        Column("b", "texts"),
        Column("c", "truth"),
        Column("d", "number"),
    ]
    rows = [['x "y"\n', ["1", "2"], True, math.inf], [None] * 4]
    (sheet,) = write(tmp_path / "t", columns, rows, Style(parquet=False))
    assert sheet.read_bytes() == b'a,b,c,d\r\n"x ""y""\n",1; 2,true,inf\r\n,,,\r\n'
    assert next(csv.reader(io.StringIO(sheet.read_text()))) == ["a", "b", "c", "d"]


def test_files_appear_only_when_they_are_whole(tmp_path: Path) -> None:
    def rows() -> Any:
        yield ["a"]
        raise KeyboardInterrupt

    (tmp_path / "t.csv").write_text("before")
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "t", [Column("a")], rows(), Style())
    assert (tmp_path / "t.csv").read_text() == "before"
    assert not (tmp_path / "t.parquet").exists()


def test_times_are_as_in_the_records() -> None:
    assert json.loads(line("x", time=TIME))["time"] == TIME
