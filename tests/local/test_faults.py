"""On one machine: whichever call the system refuses, and wherever the process is killed, no server is forgotten.

Each journey runs once to count its calls, then once for each of its fault points: a kind of call, which one of them, an
error, how far it reaches (`testing/os_faults.py`). Afterwards the participant must have come to where they come without
faults; no process, open record, timer, message, dead letter or recording in the spool may be left; and what the
participant was told is kept must be there.

All points are some thousands; the tests run a few, chosen by a fixed seed.
"""

from __future__ import annotations

import errno
import random
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from testing.os_faults import ERRORS, KILLS, OsCall, OsFault, OsReach
from tests.local.faulty_study import JOURNEYS, FaultyStudy, Stranded, run

SEED, SAMPLE = 9, 5
ELSEWHERE = OsFault(OsCall("link", ""), 0, OsReach.EVER, errno.EXDEV)


def points(study: FaultyStudy) -> Iterator[OsFault]:
    """Every fault of a journey: at the first and the last call of each kind, at the first if it only looks."""
    yield ELSEWHERE
    for call, count in sorted(study.injector.calls.items()):
        looks = call.operation in ("stat", "process", "list", "read", "open")
        for number in {1} if looks else {1, count}:
            for error in ERRORS[call.operation]:
                yield OsFault(call, number, OsReach.SPELL, error)
                if not looks:
                    yield OsFault(call, number, OsReach.ONCE, error)
            if not looks:
                for reach in KILLS:
                    yield OsFault(call, number, reach)


def went_wrong(journey: str, folder: Path, fault: OsFault | None) -> list[str]:
    """Run a journey with this fault. Returns what is wrong afterwards."""
    try:
        return run(journey, folder, fault).wrong()
    except Stranded as stranded:
        return [f"stranded: {stranded}"]
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.mark.parametrize("journey", JOURNEYS)
def test_without_faults_nothing_is_left(journey: str, tmp_path: Path) -> None:
    assert went_wrong(journey, tmp_path / "study", None) == []


@pytest.mark.parametrize("journey", ["server_is_killed", "warm_is_given"])
def test_a_study_runs_with_its_data_on_another_file_system(journey: str, tmp_path: Path) -> None:
    assert went_wrong(journey, tmp_path / "study", ELSEWHERE) == []


def test_a_sample_of_faults_leaves_nothing_wrong(tmp_path: Path) -> None:
    dice = random.Random(SEED)
    journey = dice.choice(list(JOURNEYS))
    for number, fault in enumerate(dice.sample(list(points(run(journey, tmp_path / "counted"))), SAMPLE)):
        assert went_wrong(journey, tmp_path / str(number), fault) == [], f"{journey}: {fault}"
