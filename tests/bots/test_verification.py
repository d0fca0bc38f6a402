"""Bots' data are verified, whatever they hold: a study's agent decides what is in a recording."""

from __future__ import annotations

import gzip
import json
import tracemalloc
from pathlib import Path

import pytest

from hippodrome.bots import verification
from hippodrome.bots.verification import document, read_recording

GAME = [{"kind": "header", "step": "3"}, {"kind": "reset"}, {"kind": "step"}, {"kind": "step"}, {"kind": "end"}]


def lines(*more: object) -> bytes:
    return b"".join(json.dumps(line).encode() + b"\n" for line in more)


def recorded(folder: Path, packed: bytes) -> Path:
    (folder / "3-trial.jsonl.gz").write_bytes(packed)
    return folder / "3-trial.jsonl.gz"


@pytest.mark.parametrize("more", [(), ({"kind": "break"},)])
def test_a_recording_is_read_to_its_end(tmp_path: Path, more: tuple[object, ...]) -> None:
    found = read_recording(recorded(tmp_path, gzip.compress(lines(*GAME, *more))))
    assert (found.complete, found.step, found.steps, found.pictures) == (True, "3", 2, 3)


@pytest.mark.parametrize(
    "packed",
    [
        gzip.compress(lines(*GAME))[:-9],
        gzip.compress(lines(*GAME[:-1])),
        gzip.compress(lines(*GAME[1:])),
        gzip.compress(lines(*GAME, {"kind": "break"}, {"kind": "break"})),
        gzip.compress(lines(*GAME, 7)),
        gzip.compress(lines(*GAME) + b"[" * 100_000),
        gzip.compress(b""),
        b"",
        b"no gzip",
    ],
    ids=[
        "cut off",
        "no end",
        "no header",
        "two breaks",
        "a line that is no object",
        "a line that is nested without end",
        "no lines",
        "nothing",
        "no gzip",
    ],
)
def test_an_incomplete_recording_is_recognized(tmp_path: Path, packed: bytes) -> None:
    assert not read_recording(recorded(tmp_path, packed)).complete


@pytest.mark.parametrize("line", [lines({"kind": "step"}) * 500, b"x" * 10_000])
def test_a_zip_bomb_is_no_recording_and_does_not_fill_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: bytes
) -> None:
    monkeypatch.setattr(verification, "MAX_BYTES", 2 * 1024**2)
    packed = recorded(tmp_path, gzip.compress(lines(GAME[0]) + line * 10_000))
    assert packed.stat().st_size < 1024**2
    tracemalloc.start()
    try:
        assert not read_recording(packed).complete
        assert tracemalloc.get_traced_memory()[1] < 16 * 1024**2
    finally:
        tracemalloc.stop()


def test_an_unreadable_answer_counts_as_missing(tmp_path: Path) -> None:
    (tmp_path / "3.json").write_bytes(b"[" * 60_000)
    assert document(tmp_path / "3.json") == {}
