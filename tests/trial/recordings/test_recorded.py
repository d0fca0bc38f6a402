"""How the lines of earlier servers are read, and how unusual values are recorded; no server runs here."""

import enum
import gzip
import json
import platform
import zlib
from collections import UserDict, deque
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import NamedTuple

import attrs
import numpy as np
import pytest

from hippodrome.trial.core.history import Episode, RecordedAction, RecordedStep, RecordedTrial, UnfinishedEpisode, Word
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.resume import add_lines, load_recorded


def header(rate=20):
    return {"kind": "header", "frameRate": rate}


def reset(episode=1, seed=7):
    return {"kind": "reset", "episode": episode, "seed": seed}


def step(reward=1.0, episode=1, **more):
    return {"kind": "step", "episode": episode, "human": None, "action": 2, "reward": reward, **more}


def end(why="terminated", episode=1, **more):
    return {"kind": "end", "episode": episode, "why": why, **more}


def recorded_trial(*lines, past=None):
    past = past or RecordedTrial()
    add_lines(past, lines)
    return past


def test_an_episode_that_was_cut_off_is_remembered_step_by_step():
    past = recorded_trial(header(), reset(), step(1.5, human=3), step(None), step(2))
    assert past == RecordedTrial(
        ended=[],
        unfinished=UnfinishedEpisode(
            1, 7, [RecordedStep(3, 2, 1.5), RecordedStep(None, 2, 0.0), RecordedStep(None, 2, 2.0)]
        ),
        seconds=pytest.approx(3 / 20),
    )
    assert past.unfinished.score == 3.5


@pytest.mark.parametrize("wrong", [{"messages": ["good"]}, {"players": ["a"]}, {"reward": "much"}, {"episode": None}])
def test_a_malformed_line_is_ignored(wrong):
    past = recorded_trial(reset(), step(), {**step(), **wrong}, step())
    assert len(past.unfinished.steps) == 2


def test_episodes_that_ended_are_counted_and_the_next_one_goes_on():
    past = recorded_trial(header(), reset(), step(), step(), end(), reset(2, 8), step(5.0, 2))
    assert past.ended == [Episode(1, 2, 2.0, "terminated")]
    assert past.unfinished == UnfinishedEpisode(2, 8, [RecordedStep(None, 2, 5.0)])


@pytest.mark.parametrize("rate", [0, "x", None])
def test_a_header_without_a_frame_rate_counts_thirty_frames_a_second(rate):
    assert recorded_trial(header(rate), reset(), step()).seconds == pytest.approx(1 / 30)
    assert recorded_trial(reset(), step()).seconds == pytest.approx(1 / 30)


def test_the_time_of_play_is_that_of_the_steps_and_pauses_do_not_count() -> None:
    pause = [{"ns": 3, "command": "pause"}]
    steps = [step(ns=1_000_000_000), step(ns=3_500_000_000), step(ns=9_000_000_000, messages=pause)]
    assert recorded_trial(header(10), reset(), *steps).seconds == pytest.approx(0.1 + 2.5 + 0.1)


def test_a_server_that_was_shut_down_leaves_its_episode_unfinished():
    past = recorded_trial(reset(), step(), end("shutdown"))
    assert past.ended == []
    assert len(past.unfinished.steps) == 1


def test_a_resume_drops_the_steps_that_were_not_played_again():
    lines = [reset(), step(1), step(2), step(3), {"kind": "resume", "episode": 1, "steps": 1}, step(9)]
    assert [each.reward for each in recorded_trial(*lines).unfinished.steps] == [1, 9]
    lines[4]["steps"] = -1
    assert [each.reward for each in recorded_trial(*lines).unfinished.steps] == [9]


def test_a_reset_begins_the_episode_anew():
    assert recorded_trial(reset(), step(), reset(1, 9)).unfinished == UnfinishedEpisode(1, 9)


def test_feedback_is_kept_with_the_step_that_heard_it():
    said = [{"command": "good"}, {"command": "start"}, {"action": "up"}, {"command": "bad"}]
    past = recorded_trial(reset(), step(messages=said), end("shutdown", messages=said[:1]))
    assert past.unfinished.steps == [RecordedStep(None, 2, 1.0, (Word("good"), Word("bad")))]
    assert past.unfinished.unheard == [Word("good")]
    assert recorded_trial(step(), past=past).unfinished.unheard == [], "the next step's agent has heard it"


@pytest.mark.parametrize(
    "line",
    [
        {},
        {"kind": "step"},
        {"kind": "step", "episode": 1},
        {"kind": "step", "episode": "x"},
        {"kind": "other", "episode": 1},
        {"kind": "error", "episode": 1, "why": "failed", "steps": 0},
        step(episode=2),
        end(episode=2),
        {"kind": "end", "episode": 1},
        {"kind": "resume", "episode": 1},
        {"kind": "resume", "episode": 2, "steps": 0},
        {"kind": "reset", "episode": 3},
        step("x"),
    ],
)
def test_a_line_that_makes_no_sense_changes_nothing(line):
    assert recorded_trial(reset(), step(), line) == recorded_trial(reset(), step())
    assert recorded_trial(line).ended == []


@pytest.mark.parametrize("why", ["terminated", "truncated"])
def test_an_episode_is_over_with_its_last_step_even_if_its_end_was_not_written(why):
    past = recorded_trial(reset(), step(), step(2.0, **{why: True}))
    assert (past.ended, past.unfinished) == ([Episode(1, 2, 3.0, why)], None)
    assert recorded_trial(end(), past=past).ended == [Episode(1, 2, 3.0, why)], (
        "its end, if it comes, is not a second one"
    )


def test_a_stop_in_the_break_after_an_episode_ends_the_trial():
    def after_a_break(why, number=1):
        return recorded_trial(reset(), step(), end(), {"kind": "break", "episode": number, "why": why}).ended[0].why

    assert after_a_break("stop") == "stopped"
    assert after_a_break("over") == after_a_break("stop", number=2) == "terminated"
    assert recorded_trial({"kind": "break", "episode": 1, "why": "stop"}).ended == []


@pytest.mark.parametrize(
    ("by", "advice", "asked"),
    [(None, 1, 1), ("agent", 1, 1), ("agent", None, None), ("none", None, 2), ("advice", 1, 2), ("human", 1, 2)],
)
def test_without_a_key_the_agent_was_asked_to_take_the_advice_or_the_action_that_was_taken(by, advice, asked):
    line = step(**{key: value for key, value in {"by": by, "advice": advice}.items() if value is not None})
    assert recorded_trial(reset(), line).unfinished.steps == [
        RecordedStep(None, 2, 1.0, advice=asked if by else advice)
    ]


def test_the_actions_of_several_players_are_remembered_with_their_scores():
    policy = {"action": 1, "reward": 2, "observed": 3, "by": "policy"}
    watches = {"action": None, "reward": None}
    past = recorded_trial(reset(), step(players={"a": policy, "b": watches}), step(players={"a": policy}))
    first, second = past.unfinished.steps
    assert first.players == {"a": RecordedAction(1, 2.0, 3, "policy"), "b": RecordedAction(None, 0.0)}
    assert second.players == {"a": RecordedAction(1, 2.0, 3, "policy")}
    assert past.unfinished.scores == {"a": 4.0, "b": 0.0}
    assert recorded_trial(end(), past=past).ended == [Episode(1, 2, 2.0, "terminated", {"a": 4.0, "b": 0.0})]


def test_it_is_remembered_for_which_members_of_a_session_the_trial_is_over():
    refused = {"kind": "presence", "episode": 1, "player": "c", "what": "refused"}
    came = {**refused, "player": "d", "what": "joined"}
    assert recorded_trial(reset(), refused, came).outcomes == {"c": "ping"}
    past = recorded_trial(reset(), refused, end("partnerLeft", outcomes={"a": "left", "b": "partnerLeft"}))
    assert past.outcomes == {"a": "left", "b": "partnerLeft", "c": "ping"}
    over = {"kind": "break", "episode": 1, "why": "partnerLeft", "outcomes": {"a": "left"}}
    past = recorded_trial(reset(), step(), end(), over)
    assert (past.outcomes, past.ended[0].why) == ({"a": "left"}, "partnerLeft")
    for line in (end(outcomes=["a"]), step(outcomes={"a": "left"}), {**over, "outcomes": None}):
        assert recorded_trial(reset(), line).outcomes == {}


def test_a_step_that_is_the_last_for_two_reasons_has_terminated():
    assert recorded_trial(reset(), step(terminated=True, truncated=True)).ended == [Episode(1, 1, 1.0, "terminated")]


def test_feedback_names_the_player_who_gave_it():
    said = [{"command": "good", "player": "b"}, {"command": "bad"}]
    past = recorded_trial(reset(), step(messages=said))
    assert past.unfinished.steps[0].feedback == (Word("good", "b"), Word("bad"))


class MemoryStore:
    """A store in memory."""

    def __init__(self, **files):
        self.files = {
            name: gzip.compress(b"".join(json.dumps(line).encode() + b"\n" for line in lines))
            for name, lines in files.items()
        }
        self.asked = []

    def get(self, key):
        self.asked.append(key)
        return self.files.get(key)


def test_the_recordings_of_all_servers_before_this_one_are_read_in_their_order():
    store = MemoryStore(
        **{
            "f/s-1/3-trial.jsonl.gz": [reset(), step(), end("shutdown")],
            "f/s-2/3-episode-0001.jsonl.gz": [{"kind": "resume", "episode": 1, "steps": 1}, step(2), end()],
            "f/s-2/3-episode-0002.jsonl.gz": [reset(2), step(3, 2)],
            "f/s-4/3-trial.jsonl.gz": [reset(9)],
        }
    )
    past = load_recorded(store, "f", "s-4", "3")
    assert past.ended == [Episode(1, 2, 3.0, "terminated")]
    assert past.unfinished.number == 2
    assert store.asked == [
        "f/s-1/3-trial.jsonl.gz",
        "f/s-2/3-trial.jsonl.gz",
        "f/s-2/3-episode-0001.jsonl.gz",
        "f/s-2/3-episode-0002.jsonl.gz",
        "f/s-2/3-episode-0003.jsonl.gz",
        "f/s-3/3-trial.jsonl.gz",
        "f/s-3/3-episode-0002.jsonl.gz",
    ]


def test_episodes_of_a_server_after_a_finished_one_begin_with_the_next_number():
    store = MemoryStore(
        **{
            "f/s-1/3-trial.jsonl.gz": [reset(), step(), end()],
            "f/s-2/3-episode-0002.jsonl.gz": [reset(2), step(4, 2)],
        }
    )
    assert load_recorded(store, "f", "s-3", "3").unfinished == UnfinishedEpisode(2, 7, [RecordedStep(None, 2, 4.0)])


@pytest.mark.parametrize("server", ["s-1", "s-2", "s", "s-", "s-1000", "-1", "local"])
def test_without_an_earlier_recording_there_is_no_past(server):
    assert load_recorded(MemoryStore(), "f", server, "3") is None


def test_a_recording_without_lines_counts_as_an_earlier_recording():
    assert load_recorded(MemoryStore(**{"f/s-1/3-trial.jsonl.gz": []}), "f", "s-2", "3") == RecordedTrial()


# ---- values in recordings


class LongText:
    def __str__(self):
        return "o" * 2000


class Level(enum.Enum):
    HIGH = "high"


@dataclass
class State:
    lives: int
    levels: list[Level]


class Point(NamedTuple):
    x: int
    y: int


class Tensor:
    """An array of another package, such as JAX's."""

    def __init__(self, values):
        self.values = np.array(values)

    def __array__(self, dtype=None, copy=None):
        return self.values


class WithGradient(Tensor):
    """A tensor of torch that NumPy may not read."""

    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("Can't call numpy() on Tensor that requires grad.")

    def tolist(self):
        return self.values.tolist()


class OnlyDlpack:
    def __init__(self, values):
        self.values = np.array(values)

    def __dlpack__(self, **options):
        return self.values.__dlpack__(**options)

    def __dlpack_device__(self):
        return self.values.__dlpack_device__()


@pytest.mark.parametrize(
    ("value", "kept"),
    [
        (None, None),
        (True, True),
        ("text", "text"),
        (2**70, 2**70),
        (1.5, 1.5),
        (float("nan"), None),
        (float("-inf"), None),
        (np.int64(3), 3),
        (np.float32(0.5), 0.5),
        (np.float64("inf"), None),
        (np.bool_(True), True),
        (np.array([[1, 2]]), [[1, 2]]),
        (np.array(["a", "b"]), ["a", "b"]),
        (np.array([1, "x", {"a": np.int8(2)}], object), [1, "x", {"a": 2}]),
        (np.ma.array([1.5, 2.5], mask=[False, True]), [1.5, None]),
        (np.array([(1, 2.5)], [("x", "i4"), ("y", "f8")]), {"x": [1], "y": [2.5]}),
        (np.arange(2, dtype=">f4"), [0.0, 1.0]),
        (np.array([1 + 2j]), ["(1+2j)"]),
        (np.datetime64("2026-01-01", "ns"), "2026-01-01T00:00:00.000000000"),
        (State(3, [Level.HIGH]), {"lives": 3, "levels": ["high"]}),
        (attrs.make_class("Cell", ["x"])(1), {"x": 1}),
        (Point(1, np.int64(2)), [1, 2]),
        (deque([1, 2]), [1, 2]),
        (range(3), [0, 1, 2]),
        ({"a": 1}.keys(), ["a"]),
        (UserDict(a=1), {"a": 1}),
        (Tensor([[1.5, 2.5]]), [[1.5, 2.5]]),
        (Tensor(3), 3),
        (WithGradient([1.5]), [1.5]),
        (OnlyDlpack([1.5]), [1.5]),
        ({1: {"a": (1, 2)}}, {"1": {"a": [1, 2]}}),
        (frozenset({1}), [1]),
        (b"\xff", "/w=="),
        (bytearray(b"\xff"), "/w=="),
        (LongText(), "o" * 1000),
        (np.array(["x" * 2000]), ["x" * 2000]),
    ],
)
def test_a_value_is_kept_as_json_can_hold_it(value, kept):
    assert recording.plain(value) == kept
    assert json.loads(recording.line("step", value=value)) == {"kind": "step", "value": kept}


class Raising(dict[str, int]):
    """A dict that raises when its items or its text are read."""

    def items(self):
        raise RuntimeError("no items")

    def __repr__(self):
        raise RuntimeError("no text")


class WithoutText:
    def __repr__(self):
        raise RuntimeError("no text")


@pytest.mark.parametrize(
    ("value", "kept"),
    [
        ({"a": WithoutText(), "b": 1}, {"a": "<WithoutText>", "b": 1}),
        ({WithoutText(): 1}, {"<WithoutText>": 1}),
        ([Raising(a=1), 2], ["<Raising>", 2]),
        ({"big": 2**20_000}, {"big": "<int of 20001 bits>"}),
        (np.array([1.5, float("nan")], np.float32), [1.5, None]),
        (np.longdouble("nan"), None),
        (np.array([np.longdouble(0.5)]), [0.5]),
    ],
)
def test_a_value_that_has_no_text_or_raises_does_not_end_the_game(value, kept):
    assert recording.plain(value) == kept
    assert json.loads(recording.line("step", info=value)) == {"kind": "step", "info": kept}
    assert recording.bounded_extra({"x": value}) == ({"x": kept}, {})


def tree(children):
    """Return a search tree as researchers write it: each node has its parent and its children."""
    root: dict[str, object] = {"parent": None}
    root["children"] = [{"parent": root, "children": [], "n": number} for number in range(children)]
    return root


@pytest.mark.timeout(60)
def test_objects_that_lead_to_each_other_do_not_hold_up_a_step():
    kept = json.loads(recording.line("step", info=tree(200)["children"][0]))["info"]
    assert len(kept["parent"]["children"]) == 200
    assert kept["parent"]["children"][:2] == ["<dict>", {"parent": "<dict>", "children": [], "n": 1}]
    assert recording.bounded_extra({"node": tree(3)})[0]["node"]["children"][2]["parent"] == "<dict>"
    assert recording.observation(tree(3))["children"][2]["parent"] == "<dict>"


@pytest.mark.timeout(60)
def test_a_value_of_endless_length_is_replaced_by_its_size():
    many = [[]]
    for _ in range(18):
        many = [many] * 6  # 6 ** 18 values
    kept, too_large = recording.bounded_extra({"many": many, "next": 1})
    assert kept.keys() == {"many", "next"}
    assert (kept["many"], kept["next"]) == ({"tooLarge": too_large["many"]}, 1)


@pytest.mark.timeout(60)
def test_what_is_far_too_large_is_neither_packed_nor_copied():
    array = np.broadcast_to(np.uint8(0), (1 << 40,))  # takes no memory itself
    text = "x" * 50_000_000
    kept, too_large = recording.bounded_extra({"array": array, "text": text, "bytes": text.encode(), "in": [text]})
    assert kept == {name: {"tooLarge": size} for name, size in too_large.items()}
    assert too_large["array"] >= 1 << 40
    assert all(size >= 50_000_000 for size in too_large.values())


def test_values_are_kept_twenty_levels_deep():
    deep = innermost = []
    for _ in range(19):
        deep = [deep]
    innermost.append([])
    kept = recording.plain(deep)
    for _ in range(19):
        (kept,) = kept
    assert kept == ["<list>"]


def test_a_line_is_short_and_ends_where_the_next_begins():
    assert recording.line("step", a=[1, 2], b=None) == b'{"kind":"step","a":[1,2],"b":null}\n'
    assert recording.line("step", a=float("nan"), b=1) == b'{"kind":"step","a":null,"b":1}\n'


def test_the_time_of_a_line_is_written_in_utc():
    time = datetime(2026, 11, 21, 14, 46, 40, 123456, UTC)
    assert recording.line("step", time=time) == b'{"kind":"step","time":"2026-11-21T14:46:40.123456Z"}\n'
    assert recording.line("step", time="now") == b'{"kind":"step","time":"now"}\n'


def test_an_info_may_have_a_million_bytes_of_json():
    room = 1_000_000 - len('{"a":""}')
    assert not recording.is_too_large({"a": "x" * room})
    assert recording.is_too_large({"a": "x" * (room + 1)})
    assert recording.is_too_large({"a": "x" * 1_000_001})
    assert recording.is_too_large({"a": np.broadcast_to(np.uint8(0), (1 << 40,))}), "it is not even looked at"


def test_the_values_of_a_step_share_a_million_bytes_of_json_in_their_order():
    values = {"a": "x" * 999_994, "b": [1, 2], "c": 1, "d": 1234, "e": 123, "f": 1}
    kept, too_large = recording.bounded_extra(values)
    assert too_large == {"b": 5, "d": 4, "f": 1}
    assert kept == values | {name: {"tooLarge": size} for name, size in too_large.items()}
    assert recording.bounded_extra({"a": [1, 2]}, 5) == ({"a": [1, 2]}, {})
    assert recording.bounded_extra({"a": [1, 2]}, 4) == ({"a": {"tooLarge": 5}}, {"a": 5})


def test_after_a_hundred_values_that_are_too_large_the_rest_is_counted():
    def left_out(values):
        kept, too_large = recording.bounded_extra({str(number): "x" * 9 for number in range(values)}, 10)
        assert len(too_large) == min(values, 100)
        return kept.get("<cut off>")

    assert [left_out(values) for values in (99, 100, 101, 103)] == [None, None, 1, 3]


def test_a_name_for_which_there_is_no_room_is_cut_off():
    kept, too_large = recording.bounded_extra({"n" * 2000: 1, "m" * 2001: 2}, 2001)
    assert list(kept) == ["n" * 2000, "m" * 1000]
    assert too_large == {}


def test_an_observation_is_kept_with_its_shape():
    array = np.arange(6, dtype=np.int16).reshape(2, 3).T
    kept = recording.observation({"a": [array, "x"], "b": (np.array(["y"]),)})
    assert kept["a"][0].keys() == {"dtype", "shape", "zlib"}
    assert (kept["a"][0]["dtype"], kept["a"][0]["shape"]) == ("int16", [3, 2])
    assert np.array_equal(recording.read_observation(kept["a"][0]), array)
    assert (kept["a"][1], kept["b"]) == ("x", [["y"]])


@pytest.mark.parametrize("wrap", [Tensor, lambda array: State(array, []), lambda array: array.astype(">f8")])
def test_an_array_in_any_observation_is_kept_whole(wrap):
    array = np.random.default_rng(1).random((40, 40))
    kept = recording.observation(wrap(array))
    assert np.array_equal(recording.read_observation(kept.get("lives", kept)), array)


def test_an_array_that_contains_itself_does_not_end_the_game():
    itself = np.empty((), object)
    itself[()] = itself
    assert recording.plain({"a": itself}) == {"a": "<ndarray>"}


def test_the_packages_that_a_projects_requirements_name_have_their_versions_in_the_head(tmp_path):
    (tmp_path / "requirements.txt").write_text(
        "# games\npillow>=9 # pictures\n  PyYAML ; python_version > '3'\n-r other.txt\nno-such-package-there-is==1\n"
        "git+https://example.org/x\n"
    )
    names = recording.packages(tmp_path)
    assert names == ("pillow", "PyYAML", "no-such-package-there-is", "git")
    found = recording.versions(names)
    assert found.keys() - recording.versions().keys() == {"pillow", "PyYAML"}


def test_a_recording_names_at_most_a_hundred_packages_whatever_is_written_in_the_file(tmp_path):
    (tmp_path / "requirements.txt").write_text("\ufeff" + "\n".join(f"game{number}" for number in range(120)))
    assert recording.packages(tmp_path) == tuple(f"game{number}" for number in range(100))
    (tmp_path / "other").mkdir()
    (tmp_path / "other/requirements.txt").write_bytes(b"pillow\n\xff\n")
    assert recording.packages(tmp_path / "other") == ()


def test_the_versions_include_the_trial_python_and_its_packages():
    found = recording.versions()
    assert {"trial", "python", "gymnasium", "numpy", "websockets"} <= found.keys()
    assert (found["trial"], found["python"]) == ("1.0", platform.python_version())
    assert recording.SCHEMA == 1, "as long as programs that read recordings may stay as they are"
    assert "pillow" in recording.versions(("no-such-package-there-is", "pillow"))
    installed = {name for name in ("pettingzoo", "onnxruntime") if find_spec(name)}
    assert recording.versions(recording.OF_SEVERAL).keys() - found.keys() == installed


def test_a_recording_is_dirty_until_it_is_flushed_and_closed_once(tmp_path):
    kept = recording.Recording(tmp_path / "new" / "r.part", "key")
    assert (kept.key, kept.dirty, kept.closed) == ("key", False, False)
    kept.add(recording.line("step", n=1))
    assert kept.dirty
    kept.flush()
    assert not kept.dirty
    size = kept.path.stat().st_size
    kept.flush()
    assert kept.path.stat().st_size == size, "nothing new is nothing to write"
    kept.close()
    assert kept.closed
    kept.add(recording.line("step", n=2))
    kept.flush()
    assert [line["n"] for line in recording.read(kept.path.read_bytes())] == [1]
    with pytest.raises(FileExistsError):
        recording.Recording(kept.path, "key")


def test_a_line_that_was_cut_off_is_not_read():
    whole = gzip.compress(b'{"n":1}\n{"n":2}\n{"n"')
    assert recording.read(whole) == [{"n": 1}, {"n": 2}]


def test_what_is_no_gzip_is_no_recording():
    with pytest.raises(zlib.error):
        recording.read(zlib.compress(b'{"n":1}\n'))


@pytest.mark.parametrize("success", [True, False])
def test_a_recorded_episode_succeeded_if_its_last_step_says_so(success):
    past = recorded_trial(
        reset(), step(info={"success": not success}), step(terminated=True, info={"success": success})
    )
    assert [episode.success for episode in past.ended] == [success]
