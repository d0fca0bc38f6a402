"""Lines of a recording are JSON, and can be read at any moment."""

import gzip
import json
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.recordings import recording


def test_lines_are_json_whatever_the_info(tmp_path):
    circle: dict = {}
    circle["me"] = circle
    odd = {
        "array": np.arange(3),
        "number": np.float64("nan"),
        "infinity": math.inf,
        ("a", 1): {1, 2},
        "bytes": b"x",
        "object": object(),
        "date": np.datetime64("2026-01-01"),
        "circle": circle,
    }
    line = json.loads(recording.line("step", info=odd))
    assert line["info"]["array"] == [0, 1, 2]
    assert line["info"]["number"] is None
    assert line["info"]["infinity"] is None
    seen = np.arange(12, dtype=np.float32).reshape(3, 4)
    kept = json.loads(recording.line("step", observation=recording.observation({"a": seen, "b": (1, seen)})))
    assert np.array_equal(recording.read_observation(kept["observation"]["a"]), seen)
    assert np.array_equal(recording.read_observation(kept["observation"]["b"][1]), seen)


@given(events=st.lists(st.integers(0, 3), max_size=30))
def test_a_recording_can_be_read_at_any_moment(events, tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "r.part"
    kept = recording.Recording(path, "r")
    added = flushed = 0
    for event in events:
        if event == 3:
            kept.flush()
            flushed = added
        else:
            kept.add(recording.line("step", step=added))
            added += 1
        assert [line["step"] for line in recording.read(path.read_bytes())] == list(range(flushed))
    kept.close()
    kept.close()
    assert gzip.decompress(path.read_bytes()).count(b"\n") == added
