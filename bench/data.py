"""Measures `hippodrome data`, with a bucket on moto's server in a process of its own.

`python -m bench.data N` is that server: it fills a bucket with N participants, prints the environment for its clients,
and ends when its input ends.
"""

from __future__ import annotations

import contextlib
import gzip
import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator

from bench.row import Row, row
from bench.study import folder

PARTICIPANTS, FEWER = 3_000, 1_000  # memory must not grow with the study
RECORDED = 30  # one participant in so many has a recording: moto's server answers about 200 requests a second
WHEN = "2026-11-21T14:46:40.123456Z"
FRAMES = 1_800  # steps of a recording: a minute of play


def download() -> Iterator[Row]:
    """Measure a download of all participants."""
    _, few = _run(FEWER)
    seconds, memory = _run(PARTICIPANTS)
    yield row(
        f"data: tables of {PARTICIPANTS:,} participants, one in {RECORDED} with a recording of {FRAMES:,} frames",
        seconds,
        "s",
        decides="how long a researcher waits for the data; most of it is moto's server here",
    )
    yield row(
        f"data: peak memory for {PARTICIPANTS:,} participants, against {FEWER}",
        memory,
        "MB",
        yardstick=few,
        at_most=1.3,
        decides="whether a laptop is enough for a large study",
    )


def _run(people: int) -> tuple[float, float]:
    """Run the command on a bucket with so many participants; return its seconds and its peak memory in MB."""
    with _served(people) as env, folder() as here, (here / "report").open("wb") as out:
        command = [sys.executable, "-m", "hippodrome", "data", "maze", "--to", str(here / "out"), "--json"]
        begun = time.perf_counter()
        process = subprocess.Popen(command, env={**os.environ, **env}, cwd=here, stdout=out)
        _, status, used = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - begun
        if status:
            raise RuntimeError(f"data ended with status {status}")
        counts = json.loads((here / "report").read_bytes())["counts"]
        if counts["participants"] != people or counts["problems"]:
            raise RuntimeError(f"the data are not whole: {counts}")
        return seconds, used.ru_maxrss / 1024


@contextlib.contextmanager
def _served(people: int) -> Iterator[dict[str, str]]:
    command = [sys.executable, "-m", "bench.data", str(people)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        env = next((line for line in process.stdout if line.startswith("{")), "")
        if not env:
            raise RuntimeError("moto's server did not start")
        yield json.loads(env)
        process.stdin.close()


def serve(people: int) -> None:
    """Serve a bucket with so many participants until the input ends."""
    from moto.s3.models import s3_backends

    from hippodrome.control.model import ids
    from hippodrome.control.model.project import MASTER_LIST, MasterList
    from hippodrome.control.model.records import to_json
    from hippodrome.protocol.keys import answer_key
    from testing.aws_events import ACCOUNT
    from testing.studies import study

    project, recording = study(), gzip.compress(_recording(), 6)
    with importlib.import_module("tests.deployment.installation").Installed() as world:
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
            print(json.dumps(env), flush=True)
            sys.stdin.read()


def _recording() -> bytes:
    """Make the lines of a recording, as many and as long as those of the example's game."""
    from hippodrome.trial.recordings import recording

    stamp = {"v": 1, "server": "s-1", "trial": "t", "time": WHEN, "ns": 123456789012345}
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
    serve(int(sys.argv[1]))
