"""Whole and damaged recordings become Parquet files and Minari datasets, which have no ids with `--identities apart`."""

from __future__ import annotations

import gzip
import itertools
import json
import re
import shutil
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.dataset
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from hippodrome.export import recording as converted
from hippodrome.export.scrub import Scrub
from hippodrome.trial.recordings import recording
from testing.exploration import examples
from tests.export import data_world as made_of
from tests.export.data_world import PROJECT, arrive, crowd, into_folder, key, record, recording_key, server
from tests.export.place import rows

WHO = {"participant": "p1", "studyStep": "3", "attempt": 1}


def convert(tmp: Path, body: bytes, scrub: Scrub | None = None) -> tuple[converted.Converted, list[dict[str, Any]]]:
    (tmp / "in.gz").write_bytes(body)
    done = converted.convert(tmp / "in.gz", tmp / "out.parquet", WHO, scrub or Scrub({}))
    return done, pq.read_table(tmp / "out.parquet").to_pylist()


def data(tmp: Path, *more: str, out: str = "out") -> Path:
    code = main(["data", "maze", "--to", str(tmp / out), "--from", str(tmp / "data"), "--json", *more])
    assert code == Exit.DONE
    return tmp / out


# Parquet


def test_every_line_of_a_recording_is_a_row(tmp_path: Path) -> None:
    body = record(tmp_path, "ann", episodes=3, frames=7, observe=True, messages=[{"action": "left"}], unheard_of=[1])
    lines = recording.read(body)
    done, found = convert(tmp_path, body)
    assert (done.problems, done.complete, done.frames, len(found)) == ([], True, 21, len(lines) - 1)
    assert [(e["episode"], e["seed"], e["frames"], e["score"], e["why"]) for e in done.episodes] == [
        (n, 40 + n, 7, 14.0, "terminated") for n in (1, 2, 3)
    ]
    for line, row in zip(lines[1:], found, strict=True):
        for name in ("kind", "episode", "step", "frame", "ns", "action", "actionName", "by", "human", "reward", "seed"):
            assert row[name] == line.get(name), name
        assert (row["participant"], row["studyStep"], row["attempt"], row["trial"]) == ("p1", "3", 1, "t-1")
        assert row["time"].isoformat().replace("+00:00", "Z") == line["time"]
        assert (json.loads(row["info"]) if row["info"] else None) == line.get("info")
        assert (json.loads(row["messages"]) if row["messages"] else None) == line.get("messages")
        if "observation" in line:
            seen = np.frombuffer(row["observation"], row["observationDtype"]).reshape(row["observationShape"])
            assert np.array_equal(seen, recording.read_observation(line["observation"]))
        if line["kind"] == "step":
            assert json.loads(row["other"]) == {"unheard_of": [1]}
    about = json.loads(pq.read_metadata(tmp_path / "out.parquet").metadata[b"hippodrome"])
    assert about["complete"] is True
    assert about["header"]["actionSpace"] == ["noop", "up", "down"]


@pytest.mark.parametrize("part", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_half_a_recording_gives_what_the_trial_itself_would_read(tmp_path: Path, part: float) -> None:
    whole = record(tmp_path, "ann", frames=400)
    body = whole[: int(len(whole) * part)]
    expected = recording.read(body) if body else []
    done, found = convert(tmp_path, body)
    assert [row["ns"] for row in found] == [line["ns"] for line in expected[1:]]
    assert done.problems
    assert done.complete == (part == 0.999)  # only the end of the gzip file is missing
    flushed, same = convert(tmp_path, record(tmp_path, "ann", frames=10, close=False))  # the process was killed
    assert (len(same), flushed.frames, flushed.problems) == (12, 10, ["the recording was cut off: it ends early"])


@settings(max_examples=examples(80))
@given(st.binary(max_size=300), st.integers(0, 2000), st.booleans())
def test_damaged_recordings_cause_no_crash(noise: bytes, at: int, packed: bool) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        tmp = Path(folder)
        body = record(tmp, "ann", frames=60, observe=True)
        if packed:
            text = gzip.decompress(body)
            body = gzip.compress(text[:at] + noise + text[at + len(noise) :], 1)
        else:
            body = body[:at] + noise + body[at + len(noise) :]
        done, found = convert(tmp, body)
    assert len(found) == done.rows
    assert len(done.problems) < 20


JSON = st.recursive(
    st.one_of(
        st.none(), st.booleans(), st.integers(-(2**70), 2**70), st.floats(), st.text(st.characters(), max_size=5)
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=5,
)
NAMES = st.sampled_from([*converted.schema().names, "kind", "v", "x"])


@settings(max_examples=examples(80))
@given(st.lists(st.dictionaries(NAMES, JSON, max_size=8), max_size=6))
def test_lines_with_values_of_any_type(lines: list[dict[str, Any]]) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        text = b"".join(json.dumps(line).encode() + b"\n" for line in lines)
        _, found = convert(Path(folder), gzip.compress(text))
    header = any(line.get("kind") == "header" for line in lines)
    assert len(found) == len(lines) - header
    rest = [line for number, line in enumerate(lines) if not (header and number == _first_header(lines))]
    for line, row in zip(rest, found, strict=True):
        other = json.loads(row["other"]) if row["other"] else {}
        for name, value in line.items():
            if name in ("v", "trial", "server", "kind") or value is None:
                continue
            assert row.get(name) is not None or name in other, name


def _first_header(lines: list[dict[str, Any]]) -> int:
    return next(number for number, line in enumerate(lines) if line.get("kind") == "header")


def test_a_recording_of_another_version_is_read_and_remarked(tmp_path: Path) -> None:
    lines = recording.read(record(tmp_path, "user-1"))
    body = b"".join(json.dumps({**line, "v": 99}).encode() + b"\n" for line in lines)
    done, _ = convert(tmp_path, gzip.compress(body))
    assert done.frames == 5
    assert done.problems == ["lines of the form 99 were read as those of the form 1; a newer Hippodrome may read more"]


def test_an_empty_recording_is_one_remark(tmp_path: Path) -> None:
    assert convert(tmp_path, b"")[0].problems == ["the file is empty"]


def test_the_form_that_is_converted_is_the_one_that_is_recorded() -> None:
    assert converted.RECORDED == recording.SCHEMA


def test_bombs_and_false_sizes_of_observations_are_refused(tmp_path: Path) -> None:
    big = recording.observation(np.zeros(50_000_000, np.uint8))
    lies = [
        {**big, "shape": [3]},
        {**big, "dtype": "object"},
        {**big, "dtype": "float8"},
        {**big, "shape": [-1, 2]},
        {**big, "shape": [2**40]},
        {"dtype": "uint8", "shape": [3], "zlib": "!!"},
        {"a": 1},
        [1, 2],
    ]
    text = "".join(json.dumps({"kind": "step", "episode": 1, "observation": lie}) + "\n" for lie in lies)
    _, found = convert(tmp_path, gzip.compress(text.encode()))
    assert [row["observation"] for row in found] == [None] * len(lies)
    assert [json.loads(row["other"])["observation"] for row in found] == lies
    endless = zlib.compressobj(9, zlib.DEFLATED, 31)
    packed = b"".join(endless.compress(b"x" * 2**20) for _ in range(100)) + endless.flush()
    done, _ = convert(tmp_path, packed)
    assert any("too long" in problem for problem in done.problems)


def test_long_recordings_are_written_in_groups(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(converted, "GROUP_ROWS", 100)
    body = record(tmp_path, "ann", frames=950)
    done, found = convert(tmp_path, body)
    assert pq.read_metadata(tmp_path / "out.parquet").num_row_groups == 10
    assert [row["step"] for row in found if row["kind"] == "step"] == list(range(1, 951))
    assert done.rows == 952


def test_a_recording_of_several_gzip_members_is_read_to_the_end(tmp_path: Path) -> None:
    one, two = (record(tmp_path, "ann", frames=n) for n in (3, 4))
    done, _ = convert(tmp_path, one + two)
    assert done.frames == 7


def test_all_recordings_are_one_dataset(tmp_path: Path) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 4, observe=True)
    table = pyarrow.dataset.dataset(data(tmp_path) / "recordings").to_table(columns=["participant", "reward", "kind"])
    assert table.num_rows == 3 * 7
    assert set(table["participant"].to_pylist()) == {"user-0000", "user-0001", "user-0002"}


# Minari


def load(folder: Path, name: str, monkeypatch: Any) -> Any:
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "minari"))
    return minari.load_dataset(name)


def test_minari_loads_what_was_played(tmp_path: Path, monkeypatch: Any) -> None:
    put = into_folder(tmp_path / "data")
    crowd(put, tmp_path, 1, observe=True, frames=6)
    put(recording_key("user-0000", "3-trial"), record(tmp_path, "user-0000", observe=True, frames=4, episodes=2))
    put(recording_key("user-0000", "3-episode-0002", 2), record(tmp_path, "user-0000", observe=True, attempt=2)[:-40])
    out = data(tmp_path, "--format", "minari")
    dataset = load(out, "maze-3-v0", monkeypatch)
    assert (dataset.total_episodes, dataset.total_steps) == (4, 6 + 4 + 4 + 5)
    assert dataset.action_space.n == 3
    assert (dataset.observation_space.shape, dataset.observation_space.dtype) == ((2,), np.uint8)
    for episode in dataset.iterate_episodes():
        steps = len(episode)
        assert episode.observations.tolist() == [[n, 7] for n in range(steps + 1)]
        assert episode.actions.tolist() == [n % 3 for n in range(1, steps + 1)]
        assert episode.rewards.tolist() == [0.5 * n for n in range(1, steps + 1)]
        assert episode.terminations.tolist() == [False] * (steps - 1) + [True]
        assert not episode.truncations.any()
        assert episode.infos["human"].tolist() == [-1, *(n % 3 for n in range(1, steps + 1))]
        assert json.loads(episode.infos["info"][0]) == {"start": 3}
    about = list(dataset.storage.get_episode_metadata(range(4)))
    assert [(one["participant"], one["attempt"], one["why"]) for one in about] == [
        ("user-0000", 1, "terminated"),
        ("user-0000", 1, "terminated"),
        ("user-0000", 1, "terminated"),
        ("user-0000", 2, "cut off"),
    ]
    assert [one["seed"] for one in about] == [41, 41, 42, 41]
    assert (
        "number of the step" not in json.loads((out / "minari/maze-3-v0/data/metadata.json").read_text())["description"]
    )


def test_other_values_of_a_step_are_in_tables_and_datasets(tmp_path: Path, monkeypatch: Any) -> None:
    extra = {"agentAction": 2, "word": "good"}
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, frames=6, extra=extra)
    out = data(tmp_path, "--format", "parquet,minari")
    rows = pyarrow.dataset.dataset(out / "recordings").to_table(columns=["kind", "other"]).to_pylist()
    assert [json.loads(row["other"])["extra"] for row in rows if row["kind"] == "step"] == [extra] * 6
    (episode,) = load(out, "maze-3-v0", monkeypatch).iterate_episodes()
    assert [json.loads(text) if text else None for text in episode.infos["extra"]] == [None, *[extra] * 6]


def test_a_dataset_ends_where_the_human_left_the_game(tmp_path: Path, monkeypatch: Any) -> None:
    """The other players play on, and later lines have no actions of this human."""
    put = into_folder(tmp_path / "data")
    (user,) = crowd(put, tmp_path, 1)
    lines = recording.read(record(tmp_path, user, frames=6, observe=True, head={"players": {
        "right": {"kind": "policy", "policy": "random"}, "left": {"kind": "human"}}}))  # fmt: skip
    for line in lines:
        if line["kind"] == "step":
            alive = line["step"] <= 4
            part = {"action": 1 if alive else None, "by": "human" if alive else None, "reward": 1.0 if alive else 0.0}
            line["players"] = {"right": {"action": 0, "by": "policy", "reward": 0.0}, "left": part}
            if line["step"] == 4:
                part["truncated"] = True
            if not alive:
                line["observation"] = None
    put(recording_key(user), gzip.compress(b"".join(json.dumps(line).encode() + b"\n" for line in lines)))
    (episode,) = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch).iterate_episodes()
    assert (len(episode.actions), len(episode.observations)) == (4, 5)
    assert (episode.terminations.tolist(), episode.truncations.tolist()) == ([False] * 4, [False] * 3 + [True])


def test_the_table_of_episodes_says_who_played_and_each_players_score(tmp_path: Path) -> None:
    head = {"me": {"kind": "human"}, "it": {"kind": "policy", "policy": "policies/a.onnx", "sha256": "0"}}
    did = {"me": {"action": 1, "by": "human", "reward": 2.0}, "it": {"action": 0, "by": "policy", "reward": -0.5}}
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, frames=3, head={"players": head}, players=did)
    (episode,) = rows(data(tmp_path, "--format", "csv,parquet") / "episodes.csv")
    said = {name: episode[name] for name in ("player.me", "player.it", "score.me", "score.it")}
    assert said == {"player.me": "human", "player.it": "policies/a.onnx", "score.me": "6.0", "score.it": "-1.5"}


def test_an_infinite_score_is_missing_and_a_single_player_has_no_columns(tmp_path: Path) -> None:
    did = {"me": {"reward": 1.0}, "it": {"reward": 1e308}}
    head = {"me": {"kind": "human"}, "it": {"kind": "program"}}
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, frames=2, head={"players": head}, players=did)
    (episode,) = rows(data(tmp_path, "--format", "csv,parquet") / "episodes.csv")
    assert (episode["player.it"], episode["score.it"], episode["score.me"]) == ("program", "", "2.0")
    crowd(into_folder(tmp_path / "other" / "data"), tmp_path, 1, frames=2)
    (alone,) = rows(data(tmp_path / "other", "--format", "csv,parquet") / "episodes.csv")
    assert list(alone)[-1] == "file"


def test_each_player_has_columns_and_a_dataset_is_of_the_first_human(tmp_path: Path, monkeypatch: Any) -> None:
    left, right = {"action": 1, "by": "human", "reward": 2.0}, {"action": None, "by": None, "reward": 0.5, "info": {}}
    head = {"left": {"kind": "human"}, "right": {"kind": "policy", "policy": "random"}}
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, frames=3, head={"players": head},
          players={"left": left, "right": right})  # fmt: skip
    out = data(tmp_path, "--format", "parquet,minari")
    rows = pyarrow.dataset.dataset(out / "recordings").to_table().to_pylist()
    steps = [row for row in rows if row["kind"] == "step"]
    assert [(row["action.left"], row["by.left"], row["reward.left"]) for row in steps] == [(1, "human", 2.0)] * 3
    assert [(row["action.right"], row["by.right"], row["reward.right"]) for row in steps] == [(None, None, 0.5)] * 3
    assert json.loads(steps[0]["other"])["players"] == {"left": left, "right": right}, "nothing is lost"
    (episode,) = load(out, "maze-3-v0", monkeypatch).iterate_episodes()
    assert [json.loads(text)["right"] for text in episode.infos["players"][1:]] == [right] * 3
    about = json.loads((out / "minari/maze-3-v0/data/metadata.json").read_text())
    assert "those of the first human" in about["description"]


def test_datasets_are_made_by_relative_paths_and_the_printed_path_is_absolute(
    tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, observe=True, frames=6)
    monkeypatch.chdir(tmp_path)
    assert main(["data", "maze", "--from", "data/", "--format", "minari"]) == Exit.DONE
    assert f"MINARI_DATASETS_PATH={tmp_path / 'data-maze' / 'minari'} " in capsys.readouterr().err
    assert load(Path("data-maze"), "maze-3-v0", monkeypatch).total_steps == 6


def test_pictures_are_kept_exactly(tmp_path: Path, monkeypatch: Any) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (9, 48, 40, 3), np.uint8)
    put = into_folder(tmp_path / "data")
    crowd(put, tmp_path, 1, observe=True, frames=8, picture=lambda number: noise[number])
    dataset = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch)
    assert np.array_equal(dataset[0].observations, noise)


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint64", "float16", "float64"])
def test_observations_of_other_types(tmp_path: Path, monkeypatch: Any, dtype: str) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, observe=True, picture=lambda n: np.full((), n % 2, dtype))
    episode = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch)[0]
    assert episode.observations.tolist() == [0, 1, 0, 1, 0, 1]


def as_minari(observations: Any) -> Any:
    """Return observations of Minari as plain values."""
    if isinstance(observations, dict):
        return {key: as_minari(part) for key, part in observations.items()}
    if isinstance(observations, tuple):
        return tuple(map(as_minari, observations))
    return observations if isinstance(observations, list) else observations.tolist()


@pytest.mark.parametrize(
    ("look", "held", "space"),
    [
        (lambda n: n, list(range(6)), "Box(-9223372036854775808, 9223372036854775807, (), int64)"),
        (lambda n: (12, n), [[12, n] for n in range(6)], "Box(-9223372036854775808, 9223372036854775807, (2,), int64)"),
        (lambda n: [n / 2 if n else 0, 1], [[n / 2, 1] for n in range(6)], "Box(-inf, inf, (2,), float64)"),
        (lambda n: np.full(2, n, ">f4"), [[n, n] for n in range(6)], "Box(-inf, inf, (2,), float32)"),
        (lambda n: "grün"[:n], ["grün"[:n] for n in range(6)], "Text(0, 4, charset=gnrü)"),
        (
            lambda n: {"image": np.full((1, 2), n, np.uint8), "mission": "go", "at": (n, "b")},
            {
                "image": [[[n, n]] for n in range(6)],
                "mission": ["go"] * 6,
                "at": (list(range(6)), ["b"] * 6),
            },
            "Dict('at': Tuple(Box(-9223372036854775808, 9223372036854775807, (), int64), Text(0, 2, charset=bgo)), "
            "'image': Box(0, 255, (1, 2), uint8), 'mission': Text(0, 2, charset=bgo))",
        ),
    ],
)
def test_observations_of_other_spaces_are_in_datasets(
    tmp_path: Path, monkeypatch: Any, look: Any, held: Any, space: str
) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, observe=True, picture=look)
    dataset = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch)
    assert as_minari(dataset[0].observations) == held
    assert str(dataset.observation_space) == space


def test_nan_in_a_list_of_numbers_is_nan_in_a_dataset(tmp_path: Path, monkeypatch: Any) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, observe=True, picture=lambda n: [n, float("nan")])
    episode = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch)[0]
    assert np.array_equal(episode.observations, [[n, np.nan] for n in range(6)], equal_nan=True)


def test_numbers_that_are_whole_in_some_recordings_are_in_one_dataset(tmp_path: Path, monkeypatch: Any) -> None:
    calls = itertools.count()
    crowd(into_folder(tmp_path / "data"), tmp_path, 3, observe=True, picture=lambda n: [n, next(calls) // 6 / 2 or 0])
    dataset = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch)
    assert [episode.observations[:, 1].tolist() for episode in dataset] == [[0.0] * 6, [0.5] * 6]


def test_arrays_without_values_whose_space_minari_cannot_read_make_a_dataset_of_step_numbers(
    tmp_path: Path, monkeypatch: Any
) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, observe=True, picture=lambda n: {"others": np.zeros((0, 3))})
    dataset = load(data(tmp_path, "--format", "minari"), "maze-3-v0", monkeypatch)
    assert dataset[0].observations.tolist() == [[0], [1], [2], [3], [4], [5]]


@pytest.mark.parametrize("look", [lambda n: [1] * n, lambda n: {"a/b": n}, lambda n: [n] if n % 2 else {"a": n}])
def test_if_minari_has_no_space_the_run_and_the_dataset_say_that_observations_were_recorded(
    tmp_path: Path, monkeypatch: Any, capsys: Any, look: Any
) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 1, observe=True, picture=look)
    out = tmp_path / "out"
    assert main(["data", "maze", "--to", str(out), "--from", str(tmp_path / "data"), "--format", "minari"]) == 0
    dataset, told = load(out, "maze-3-v0", monkeypatch), capsys.readouterr().err
    assert "maze-3-v0: observations were recorded, but Minari has no space for them: steps' numbers stand" in told
    assert "recordObservations" not in told
    assert dataset[0].observations.tolist() == [[0], [1], [2], [3], [4], [5]]
    assert "The observations were recorded, but Minari has no space" in dataset.storage.metadata["description"]
    rows = pyarrow.dataset.dataset(tmp_path / "out/recordings").to_table(columns=["kind", "other"]).to_pylist()
    assert next(json.loads(row["other"])["observation"] for row in rows if row["kind"] == "step") == look(1)


def test_without_observations_a_dataset_holds_step_numbers_and_the_run_says_so(
    tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    crowd(into_folder(tmp_path / "data"), tmp_path, 3)
    assert main(["data", "maze", "--to", str(tmp_path / "out"), "--from", str(tmp_path / "data"), "--format", "minari"]) == 0  # fmt: skip
    told = capsys.readouterr().err
    assert "observations were not recorded" in told
    assert "`recordObservations: true`" in told
    dataset = load(tmp_path / "out", "maze-3-v0", monkeypatch)
    assert len(dataset) == 2
    assert dataset[1].observations.tolist() == [[0], [1], [2], [3], [4], [5]]
    assert (
        "number of the step"
        in json.loads((tmp_path / "out/minari/maze-3-v0/data/metadata.json").read_text())["description"]
    )


def test_a_game_that_changed_during_the_study_makes_two_datasets(tmp_path: Path, monkeypatch: Any) -> None:
    put = into_folder(tmp_path / "data")
    users = crowd(put, tmp_path, 3, observe=True)
    late = record(tmp_path, users[2], observe=True, picture=lambda n: np.zeros((3, 3), np.float32))
    put(recording_key(users[2]), late)
    out = data(tmp_path, "--format", "minari")
    assert sorted(path.name for path in (out / "minari").iterdir()) == ["maze-3-v0", "maze-3-v1"]
    shapes = {load(out, f"maze-3-v{n}", monkeypatch).observation_space.shape for n in (0, 1)}
    assert shapes == {(2,), (3, 3)}


def test_episodes_that_minari_cannot_hold_are_counted(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    put = into_folder(tmp_path / "data")
    crowd(put, tmp_path, 2, observe=True)
    lines = recording.read(record(tmp_path, "user-0001", observe=True))
    lines[3]["action"] = None
    lines[3]["time"] = "2099"
    more = [dict(line, episode=2) for line in lines[1:]]
    del more[2]["observation"]
    more[2]["action"] = 1
    broken = b"".join(json.dumps(line).encode() + b"\n" for line in [*lines, *more])
    put(recording_key("user-0001"), gzip.compress(broken))
    code = main(["data", "maze", "--to", str(tmp_path / "out"), "--from", str(tmp_path / "data"), "--format", "minari", "--json"])  # fmt: skip
    assert code == Exit.DONE
    (dataset,) = json.loads(capsys.readouterr().out)["minari"]
    assert dataset["episodes"] == 1
    assert sorted(dataset["leftOut"].values()) == [1, 1]


def test_datasets_are_made_again_only_when_recordings_change(tmp_path: Path) -> None:
    put = into_folder(tmp_path / "data")
    users = crowd(put, tmp_path, 3)
    file = data(tmp_path, "--format", "csv,parquet,minari") / "minari/maze-3-v0/data/main_data.hdf5"
    first = file.stat().st_mtime_ns
    data(tmp_path, "--format", "csv,parquet,minari")
    data(tmp_path)
    assert file.stat().st_mtime_ns == first
    put(recording_key(users[2]), record(tmp_path, users[2]))
    data(tmp_path)
    assert file.stat().st_mtime_ns > first
    file.write_bytes(b"damaged")
    data(tmp_path, "--format", "minari")
    assert file.stat().st_size > 1000


# Identities apart


def test_with_identities_apart_only_private_files_name_participants(tmp_path: Path, monkeypatch: Any) -> None:
    import h5py

    put = into_folder(tmp_path / "data")
    users = crowd(put, tmp_path, 3, observe=True, frames=30)
    hidden = set()
    for user in users:
        about = made_of.participant(user)
        words = f"I am {user.upper()} ({about['link']['PROLIFIC_PID']}), code {about['completionCode']}"
        arrive(put, user, {"2": {"words": words, "field": [user, words]}})
        told = {"user": user, "pid": about["link"]["PROLIFIC_PID"], "server": server(user)}
        error = f"no such file /home/{user}/x"
        put(
            recording_key(user, "3-episode-0009"),
            record(tmp_path, user, messages=[told], error=error, more={"of": user}),
        )
        put(recording_key(user, "3-episode-0008"), record(tmp_path, user)[:200])
        put(key(user, f"{user}.txt"), b"?")
        put(key(user, f"trials/{user}-7/3-trial.jsonl.gz"), record(tmp_path, user))
        put(key(user, f"answers/{user}.json"), b"[]")
        hidden |= {user, about["link"]["PROLIFIC_PID"], about["completionCode"], server(user).rpartition("-")[0]}
    out = data(tmp_path, "--identities", "apart", "--format", "csv,parquet,minari", "--long", "--raw")

    shown = []
    for path in out.rglob("*"):
        if "private" in path.relative_to(out).parts:
            continue
        shown.append(path.relative_to(out).as_posix())
        if path.suffix == ".parquet":
            shown.append(str(pq.read_table(path).to_pylist()) + str(pq.read_metadata(path).metadata))
        elif path.suffix == ".hdf5":
            with h5py.File(path) as file:
                file.visititems(lambda name, item: shown.append(name + str(dict(item.attrs)) + str(item[()] if isinstance(item, h5py.Dataset) else "")))  # fmt: skip
        if path.is_file():
            shown.append(path.read_bytes().decode("latin-1"))
    everything = "\n".join(shown).casefold()
    assert "participant" in everything
    assert [one for one in hidden if one.casefold() in everything] == []
    known = rows(out / "private/identities.csv")
    assert {row["userId"] for row in known} == set(users)
    assert known[0]["link.PROLIFIC_PID"] == f"prolific-of-{known[0]['userId']}"
    assert known[0]["completionCode"]
    assert (out / "private").stat().st_mode & 0o077 == 0


def test_participants_numbers_are_random_and_stay_the_same_in_later_runs(tmp_path: Path) -> None:
    put = into_folder(tmp_path / "data")
    users = crowd(put, tmp_path, 6)

    def numbers(out: Path) -> dict[str, str]:
        return {row["userId"]: row["participant"] for row in rows(out / "private/identities.csv")}

    out = data(tmp_path, "--identities", "apart")
    first = numbers(out)
    arrive(put, "user-new", {"1": {"consent": "yes"}})
    assert {
        user: number for user, number in numbers(data(tmp_path, "--identities", "apart")).items() if user in users
    } == first
    listed = (out / "manifest.json").read_bytes()
    shutil.rmtree(out / "private/records")  # identities.csv alone keeps them
    assert numbers(data(tmp_path, "--identities", "apart", "--spreadsheet"))["user-0003"] == first["user-0003"]
    shutil.rmtree(out / "private/records")
    assert numbers(data(tmp_path, "--identities", "apart"))["user-0003"] == first["user-0003"]
    assert json.loads((out / "manifest.json").read_bytes())["files"] == json.loads(listed)["files"]
    shutil.rmtree(out / "private/records")
    (out / "private/identities.csv").unlink()
    assert main(["data", "maze", "--to", str(out), "--from", str(tmp_path / "data"), "--identities", "apart"]) == Exit.FAILED  # fmt: skip
    again = numbers(data(tmp_path, "--identities", "apart", out="elsewhere"))
    assert not set(again.values()) & set(first.values())  # drawn, not computed


def test_new_values_of_the_link_convert_recordings_again(tmp_path: Path) -> None:
    """The recording was converted before the link's values were known."""
    put = into_folder(tmp_path / "data")
    (user,) = crowd(put, tmp_path, 1)
    put(recording_key(user), record(tmp_path, user, messages=["secret-value"]))
    out = data(tmp_path, "--identities", "apart")
    arrive(put, user, {}, link={"PROLIFIC_PID": "secret-value"})
    data(tmp_path, "--identities", "apart")
    (path,) = (out / "recordings").rglob("*.parquet")
    assert "secret-value" not in str(pq.read_table(path).to_pylist())
    assert PROJECT.id == "maze"


# The documentation


def test_the_examples_of_the_documentation_work(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "data.md").read_text()
    blocks = [block.replace("ms-pacman", "maze") for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)]
    (parquet,) = [block for block in blocks if "pyarrow" in block]
    (minari,) = [block for block in blocks if "minari" in block]
    crowd(into_folder(tmp_path / "data"), tmp_path, 3, observe=True)
    data(tmp_path, "--format", "csv,parquet,minari", out="data-maze")
    look = "print(rewards.num_rows, picture(frames.to_table().to_pylist()[0]).tolist())\n"
    count = "print(len(dataset), dataset[0].rewards.sum())\n"
    for program, told in ((parquet + look, "10 [0, 7]"), (minari + count, "2 7.5")):
        line = [sys.executable, "-c", program]
        ran = subprocess.run(line, cwd=tmp_path, capture_output=True, text=True, check=True)
        assert ran.stdout.strip() == told
