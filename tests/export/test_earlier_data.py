"""The data of an earlier version (`tests/earlier/study`) become the same tables as before."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from console.problem import Exit
from deploy.__main__ import main

STUDY = Path(__file__).resolve().parents[1] / "earlier" / "study"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder that `data` fills from this study."""
    folder = tmp_path_factory.mktemp("earlier") / "out"
    assert main(["data", str(folder), "--project", "tiny", "--from", str(STUDY)]) == Exit.DONE
    return folder


def rows(out: Path, table: str) -> list[dict[str, str]]:
    with (out / f"{table}.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_answers(out: Path) -> None:
    (row,) = rows(out, "answers")
    sent = json.loads(next(STUDY.glob("tiny/users/*/answers/2.json")).read_text())["answers"]
    assert {key: row[f"2.{key}"] for key in sent} == sent
    assert (row["finished"], row["3.score"], row["completionCode"]) == ("true", "90", "NA3F5JIDMS")


def test_recordings(out: Path) -> None:
    episodes = rows(out, "episodes")
    assert [(row["frames"], row["score"], row["why"]) for row in episodes] == [("45", "45.0", "terminated")] * 2
    for row in episodes:
        kinds = pq.read_table(out / row["file"]).column("kind").to_pylist()
        assert kinds.count("step") == 45
    assert rows(out, "problems") == []
