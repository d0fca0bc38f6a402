"""Measures the speed and the memory of `data`, with a bucket on moto's server in a process of its own.

`python -m bench.data serve N` is that server: it fills a bucket with N participants, prints the environment for its
clients, and ends when its input ends.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from bench import memory
from bench.table import Row, each, row

ROOT = Path(__file__).parents[1]
PARTICIPANTS = 10_000
FEWER = 1_000  # participants of the yardstick of memory, which must not grow with the study
RECORDED = 50  # one participant in so many has a recording: moto's server answers about 200 requests a second at most
WHEN = "2026-11-21T14:46:40.123456Z"
FRAMES = 1_800  # steps of a recording: a minute of play


class DataRun(NamedTuple):
    """A run of the command: its seconds, its peak memory in MB, and the JSON that it printed."""

    seconds: float
    memory: float
    report: dict[str, Any]


def rows() -> Iterator[Row]:
    """Measure the command; about two minutes."""
    yield from each([download])


def download() -> Iterator[Row]:
    """Measure a download of all participants, and another one without new data."""
    few, _ = _measured(FEWER)
    many, again = _measured(PARTICIPANTS)
    counts = many.report["counts"]
    if counts["participants"] != PARTICIPANTS or counts["problems"]:
        raise RuntimeError(f"the data are not whole: {counts}")
    objects = many.report["run"]["new"]
    shape = f"one answer each, and one in {RECORDED} a recording of {FRAMES:,} frames, as moto is slow"
    yield row(
        f"data: {PARTICIPANTS:,} participants ({shape})",
        PARTICIPANTS / many.seconds,
        "participants/s",
        detail={
            "seconds": many.seconds,
            "files": objects,
            "files/s": objects / many.seconds,
            "frames": counts["frames"],
        },
    )
    yield row(
        f"data: peak memory for {PARTICIPANTS:,}, beside {FEWER:,}",
        many.memory,
        "MB",
        yardstick=few.memory,
        at_most=1.3,
    )
    yield row(
        f"data: again, nothing new ({objects:,} files listed, {counts['recordings']:,} kept files hashed)",
        again.seconds,
        "s",
    )


def _measured(people: int) -> tuple[DataRun, DataRun]:
    """Run the command twice on a bucket with so many participants; return both runs."""
    with _served(people) as env, tempfile.TemporaryDirectory() as folder:
        return _run(env, Path(folder)), _run(env, Path(folder))


def _run(env: dict[str, str], folder: Path) -> DataRun:
    arguments = ["data", str(folder / "out"), "--project", "maze", "--json"]
    begun = time.perf_counter()
    with (folder / "told.json").open("w+b") as out, (folder / "said.txt").open("w+b") as err:
        status, held = memory.run("deploy", arguments, env=env, cwd=folder, out=out, err=err)
        seconds = time.perf_counter() - begun
        out.seek(0)
        err.seek(0)
        if status:
            raise RuntimeError(f"data ended with {status}: {err.read().decode()[-2000:]}")
        return DataRun(seconds, held, json.loads(out.read()))


# The server


@contextlib.contextmanager
def _served(people: int) -> Iterator[dict[str, str]]:
    command = [sys.executable, "-m", "bench.data", "serve", str(people)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as process:
        if process.stdout is None or process.stdin is None:
            raise RuntimeError("no pipes")
        try:
            env = next((line for line in process.stdout if line.startswith("{")), "")
            if not env:
                raise RuntimeError("moto's server did not start")
            yield json.loads(env)
        finally:
            process.stdin.close()
            process.wait(30)


def _serve(people: int) -> None:
    import gzip

    from moto.s3.models import s3_backends

    from hippodrome.model import ids
    from hippodrome.model.project import MASTER_LIST, MasterList
    from hippodrome.model.records import to_json
    from protocol.keys import answer_key
    from testing.aws_events import ACCOUNT
    from testing.studies import study

    project = study()
    recording = gzip.compress(_recording(), 6)
    with importlib.import_module("tests.deploy.installation").Installed() as world:
        backend, bucket = s3_backends[ACCOUNT]["aws"], world.env["BUCKET"]

        def put(key: str, body: bytes) -> None:
            backend.put_object(bucket, key, body)  # not over HTTP, which would take longer than the measured command

        put(MASTER_LIST, to_json(MasterList([project])))
        for number in range(people):
            user = f"{number:024x}"
            answers = {"age": "33", "words": "The ghosts were fast. " * 5, "pet": ["cat", "dog"]}
            answer = {"step": "2", "page": "questionnaire", "group": number % 2, "answered": WHEN, "answers": answers}
            put(answer_key(project.id, user, "2"), json.dumps(answer).encode())
            if number % RECORDED == 0:
                server = ids.server_name(ids.server_label(project.id, user), 1)
                put(f"{project.id}/users/{user}/trials/{server}/3-episode-0001.jsonl.gz", recording)
        with world.served() as env:
            sys.stdout.write(json.dumps(env) + "\n")
            sys.stdout.flush()
            sys.stdin.read()


def _recording() -> bytes:
    """Make the lines of a recording, as many and as long as those of the example project's game."""
    from trial.recordings import recording

    stamp = {"v": 1, "session": "s-1", "trial": "t", "time": WHEN, "ns": 123456789012345}
    lines = [recording.line("header", **stamp, actionSpace=["noop"] * 9, episode=1, seed=5)]
    lines += [recording.line("reset", **stamp, episode=1, seed=5, info={"lives": 3})]
    lines += [
        recording.line(
            "step", **stamp, episode=1, step=n, frame=n, human=n % 9, action=n % 9, actionName="upright", by="human",
            reward=10.0 * (n % 7 == 0), terminated=n == FRAMES, truncated=False,
            info={"lives": 3, "episode_frame_number": n, "frame_number": n},
        )
        for n in range(1, FRAMES + 1)
    ]  # fmt: skip
    lines += [recording.line("end", **stamp, episode=1, steps=FRAMES, score=1.0, why="terminated")]
    return b"".join(lines)


if __name__ == "__main__":
    if sys.argv[1:2] == ["serve"]:
        _serve(int(sys.argv[2]))
    else:
        from bench.__main__ import main

        sys.exit(main(["data"]))
