"""The tables of a study with a design, and the analyses that they are for."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import pytest

from hippodrome.export import run as export_run
from hippodrome.export.source import Folder
from testing.designed import DesignedStudy, write
from testing.fake_platform import FakePlatform

CONFIG = """
project:
  id: cec
  conditions: {advice: [on, off]}
  steps:
    - consent
    - quiz: {right: {soups: 3}, tries: 2}
    - each: {partner: [sp, bs, cec]}
      steps: [game: {players: {human: human, partner: "agent:{partner}"}}, trust]
    - debrief
  ends: {declined: answers.consent.agree == "no"}
trial: {game: kitchen}
"""
PAGES = {
    "consent": "<input name='agree'>",
    "quiz": "<input name='soups'>",
    "trust": "<input name='q1' type='number'><input name='q2' type='number'>",
    "debrief": "<p>Thanks</p>",
}


@pytest.fixture
def tables(tmp_path: Path) -> Path:
    """The tables of seven people: one declined, and each of the others scored 10 with sp, 20 with bs, 30 with cec."""
    from hippodrome.functions import installed

    platform = FakePlatform()
    installed.use(platform)
    study = DesignedStudy(write(tmp_path / "study", CONFIG, PAGES), platform)
    for number in range(7):
        user = f"P{number}"
        person = study.visitor(user)
        person.answer(person.get(), agree="no" if number == 6 else "yes")
        if number == 6:
            person.get()
            continue
        if number == 0:
            person.answer(person.get(), soups="4")
        person.answer(person.get(), soups="3")
        person.get()
        for key, game in study.stored(user, "assignment")["games"].items():
            score = {"sp": 10, "bs": 20, "cec": 30}[game["levels"]["partner"]]
            study.play(user, key, score=score)
            person.answer(person.get(), q1="5", q2=str(score // 10))
    data = tmp_path / "data"
    for key, (body, *_) in platform.documents.kept.items():
        path = data / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(body)
    out = tmp_path / "out"
    export_run.run(
        Folder(data), "cec", out, export_run.Options(frozenset({"csv", "parquet"}), False, False, False, False)
    )
    return out


def rows(file: Path) -> list[dict[str, str]]:
    with file.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def test_a_row_per_person_has_the_end_the_factors_and_the_order(tables: Path) -> None:
    people = {row["participant"]: row for row in rows(tables / "answers.csv")}
    declined = people["P6"]
    assert (declined["end"], declined["advice"], declined["order.partner"]) == ("declined", "", "")
    first = people["P0"]
    assert (first["end"], first["finished"], first["quiz.passed"], first["quiz.tries"]) == (
        "complete",
        "true",
        "true",
        "2",
    )
    assert first["advice"] in ("on", "off")
    assert sorted(first["order.partner"].split()) == ["bs", "cec", "sp"]
    assert (first["game.cec.score"], first["trust.cec.q2"]) == ("30", "3")
    assert not any("-" in name.partition(".")[0] for name in first), "no key of a run stands in a column's name"


def test_a_row_per_person_and_run_has_levels_and_answers(tables: Path) -> None:
    runs = rows(tables / "runs.csv")
    assert len(runs) == 6 * 3
    assert {(row["partner"], row["game.score"], row["trust.q2"]) for row in runs} == {
        ("sp", "10", "1"),
        ("bs", "20", "2"),
        ("cec", "30", "3"),
    }
    assert {row["position"] for row in runs} == {"1", "2", "3"}


def test_tries_assignments_and_ends_are_not_counted_as_answers(tables: Path) -> None:
    counts = json.loads((tables / "manifest.json").read_text())["counts"]
    assert counts["answers"] == 7 + 6 * (1 + 2 * 3)  # consent; the check, and three runs of game and trust


def test_each_try_is_kept(tables: Path) -> None:
    tries = [(row["participant"], row["try"], row["value"]) for row in rows(tables / "tries.csv")]
    assert tries[:2] == [("P0", "1", "4"), ("P0", "2", "3")]
    assert len(tries) == 7


def test_no_file_is_foreign(tables: Path) -> None:
    assert rows(tables / "problems.csv") == []


def test_the_analyses_of_the_docs_are_one_line_each(tables: Path) -> None:
    import pyarrow.compute as pc
    import pyarrow.parquet as pq

    runs: Any = pq.read_table(tables / "runs.parquet")
    means = runs.group_by("partner").aggregate([("game.score", "mean")]).to_pylist()
    assert {row["partner"]: row["game.score_mean"] for row in means} == {"sp": 10, "bs": 20, "cec": 30}
    people: Any = pq.read_table(tables / "answers.parquet")
    complete = people.filter(pc.equal(people["end"], "complete"))
    assert complete.group_by("advice").aggregate([("game.cec.score", "mean")]).num_rows == 2
    assert json.loads((tables / "manifest.json").read_text())["project"] == "cec"
