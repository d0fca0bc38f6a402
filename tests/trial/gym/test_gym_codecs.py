"""Spaces and values of every kind travel both ways, by JSON and by raw arrays, and arrive as they were."""

from __future__ import annotations

import base64
import json
import struct
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from tests.trial.gym.space_strategies import SEEDS, SPACES, same, sampled
from trial.gym import arrays, exact, values
from trial.gym.spaces import CodecError, build, describe

IMAGE = spaces.Box(0, 255, (210, 160, 3), np.uint8)


def over_json(value: Any) -> Any:
    return json.loads(values.to_text(value))


@given(SPACES, st.booleans())
def test_a_space_is_built_again_from_its_description(space: Any, compact: bool) -> None:
    built = build(over_json(describe(space, compact=compact)))
    assert built == space
    assert describe(built, compact=compact) == describe(space, compact=compact)


@given(SPACES, SEEDS)
def test_a_built_space_samples_what_the_space_itself_samples(space: Any, seed: int) -> None:
    built = build(over_json(describe(space)))
    assert all(map(same, sampled(built, seed, 2), sampled(space, seed, 2)))


@given(SPACES, SEEDS)
def test_values_travel_as_json(space: Any, seed: int) -> None:
    read = values.decoder(space)
    for value in sampled(space, seed, 3):
        assert same(read(over_json(value)), value)


@given(SPACES, SEEDS, st.integers(1, 5))
def test_batches_travel_as_raw_arrays(space: Any, seed: int, count: int) -> None:
    layout = arrays.layout(space)
    rows = sampled(space, seed, count)
    batch = arrays.batch_of(layout, rows)
    message = arrays.step_request(arrays.STEP_MANY, 7, count, layout, batch)
    request = arrays.read_request(message)
    assert (request.kind, request.handle, request.steps) == (arrays.STEP_MANY, 7, count)
    found = layout.rows(arrays.read_actions(request, layout), count)
    assert all(map(same, found, rows))


# --- the form that Gymie's client reads ---


def test_descriptions_have_gymies_fields() -> None:
    box = describe(spaces.Box(np.array([-1, -2], np.float32), np.array([1, np.inf], np.float32)))
    assert {key: box[key] for key in ("name", "shape", "low", "high")} == {
        "name": "Box",
        "shape": [2],
        "low": [-1.0, -2.0],
        "high": [1.0, np.inf],
    }
    assert describe(spaces.Discrete(4)).items() >= {"name": "Discrete", "n": 4}.items()
    assert describe(spaces.MultiBinary(5)) == {"name": "MultiBinary", "n": 5, "shape": [5]}
    assert describe(spaces.MultiBinary([2, 3])) == {"name": "MultiBinary", "n": [2, 3], "shape": [2, 3]}


def test_gymies_own_descriptions_are_built() -> None:
    assert build({"name": "Discrete", "n": 4}) == spaces.Discrete(4)
    said = {"name": "Box", "shape": [2], "low": [-5.0, -5.0], "high": [5.0, 5.0]}
    assert build(said) == spaces.Box(-5, 5, (2,), np.float32)
    assert build({"name": "MultiBinary", "n": 5, "shape": [5]}) == spaces.MultiBinary(5)


def test_in_the_compact_form_equal_bounds_are_two_numbers() -> None:
    said = describe(IMAGE, compact=True)
    assert (said["low"], said["high"]) == (0, 255)
    assert build(said) == IMAGE


def test_a_dict_keeps_the_order_of_its_keys() -> None:
    space = spaces.Dict([("b", spaces.Discrete(2)), ("a", spaces.Discrete(3))])
    assert list(build(over_json(describe(space)))) == ["b", "a"]


def test_infinities_and_nan_are_sent_as_numbers_that_every_reader_of_json_takes() -> None:
    text = values.to_text({"Infinity": [np.inf, -np.inf, np.float32("nan"), 1.5], 'NaN"': "-Infinity"})
    assert text == r'{"Infinity":[1e999,-1e999,null,1.5],"NaN\"":"-Infinity"}'


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_observations_keep_infinities_and_nan(dtype: Any) -> None:
    space = spaces.Box(-1, 1, (2, 2), dtype)
    value = np.array([[np.inf, -np.inf], [np.nan, 0.1]], dtype)
    assert same(values.decoder(space)(over_json(value)), value)
    layout = arrays.layout(space)
    request = arrays.read_request(arrays.step_request(arrays.STEP, 0, 1, layout, arrays.batch_of(layout, [value])))
    assert same(layout.rows(arrays.read_actions(request, layout), 1)[0], value)


# --- what is refused ---


class OwnSpace(spaces.Space[Any]):
    """A space that is none of Gymnasium's own."""


@pytest.mark.parametrize(
    "call",
    [
        lambda: describe(OwnSpace()),
        lambda: values.decoder(OwnSpace()),
        lambda: arrays.layout(OwnSpace()),
        lambda: describe(spaces.Dict({1: spaces.Discrete(2)})),  # type: ignore[dict-item]
        lambda: describe(spaces.Box(0, 1, (2,), np.longdouble)),
    ],
)
def test_a_space_that_cannot_be_sent_gets_a_sentence(call: Any) -> None:
    with pytest.raises(CodecError, match=r"cannot be sent.*\.$"):
        call()


BOX = {"name": "Box", "shape": [2], "low": [0, 0], "high": [1, 1]}
WRONG_DESCRIPTIONS: list[Any] = [
    None,
    [],
    "Discrete",
    {},
    {"name": "Discreate", "n": 4},
    {"name": ["Box"]},
    {"name": "Discrete"},
    {"name": "Discrete", "n": 0},
    {"name": "Discrete", "n": "4"},
    {"name": "Discrete", "n": 2.5},
    {"name": "Discrete", "n": True},
    {"name": "Discrete", "n": 2**70},
    {"name": "Discrete", "n": 4, "dtype": "float32"},
    {"name": "Discrete", "n": 4, "dtype": "object"},
    {"name": "Discrete", "n": 4, "dtype": "no such"},
    {"name": "Box"},
    BOX | {"low": [2, 2]},
    BOX | {"low": [0, 0, 0]},
    BOX | {"low": [None, 0]},
    BOX | {"low": [[0], [0, 1]]},
    BOX | {"low": "zero"},
    BOX | {"shape": [-2]},
    BOX | {"shape": 2},
    BOX | {"shape": [2**62, 2**62], "low": 0, "high": 1},
    BOX | {"shape": [1] * 33},
    BOX | {"dtype": "complex128"},
    BOX | {"dtype": "int8", "high": [300, 300]},
    BOX | {"dtype": "O"},
    {"name": "MultiBinary", "n": -1},
    {"name": "MultiBinary", "n": [2**40, 2**40]},
    {"name": "MultiDiscrete"},
    {"name": "MultiDiscrete", "nvec": [0]},
    {"name": "MultiDiscrete", "nvec": ["a"]},
    {"name": "MultiDiscrete", "nvec": [2, 2], "start": [0]},
    {"name": "Text"},
    {"name": "Text", "max_length": 1, "min_length": 2},
    {"name": "Dict"},
    {"name": "Dict", "spaces": []},
    {"name": "Dict", "spaces": {"a": 3}},
    {"name": "Tuple", "spaces": 3},
    {"name": "Tuple", "spaces": [{"name": "Tuple"}]},
    {"name": "Sequence"},
    {"name": "Graph", "node_space": None},
    {"name": "OneOf", "spaces": []},
]


@pytest.mark.parametrize("said", WRONG_DESCRIPTIONS, ids=lambda said: repr(said)[:60])
def test_a_wrong_description_gets_a_sentence(said: Any) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        build(said)


def test_a_very_deeply_nested_description_gets_a_sentence() -> None:
    said: Any = {"name": "Discrete", "n": 1}
    for _ in range(5000):
        said = {"name": "Tuple", "spaces": [said]}
    with pytest.raises(CodecError, match=r"\.$"):
        build(said)


FLOATS = spaces.Box(-1, 1, (2,), np.float32)
BYTES = spaces.Box(0, 255, (2,), np.uint8)
PAIR = spaces.Tuple([spaces.Discrete(2), FLOATS])
NAMED = spaces.Dict({"a": spaces.Discrete(2)})
GRAPH = spaces.Graph(spaces.Discrete(3), spaces.Discrete(2))
WRONG_VALUES: list[tuple[Any, Any]] = [
    *((FLOATS, said) for said in (None, "1", 1, [1], [1, 2, 3], [[1, 2]], [[1], [1, 2]], ["1", "2"], [{}, 1], {})),
    *((BYTES, said) for said in ([1.5, 2], [-1, 0], [256, 0], [2**70, 0], [None, 0])),
    *((spaces.Box(0, 1, (2,), bool), said) for said in ([2, 0], [0.5, 0])),
    *((spaces.Discrete(2), said) for said in (None, "1", 1.0, [1], True, 2**70)),
    *((spaces.Discrete(2, dtype=np.int8), said) for said in (128, -129)),
    *((spaces.MultiBinary(2), said) for said in ([1], [300, 0], [0.5, 0], "10")),
    *((spaces.MultiDiscrete([2, 2]), said) for said in ([1], [2**63, 0], [0.5, 0], 1)),
    *((spaces.Text(3), said) for said in (None, 1, ["a"])),
    *((NAMED, said) for said in (None, [], {}, {"b": 1}, {"a": 1, "b": 1}, {"a": None})),
    *((PAIR, said) for said in (None, {}, [], [1], [1, [0, 0], 2], [1, [0]])),
    *((spaces.Sequence(spaces.Discrete(2)), said) for said in (None, 1, {"0": 1}, ["a"])),
    *((spaces.Sequence(FLOATS, stack=True), said) for said in (None, [1], [[1]], [[1, 2], [1]])),
    *((GRAPH, said) for said in (None, [], [[1], None], [[1], [1], None], [[1], [0], [[0]]], [["a"], None, None])),
    (spaces.Graph(spaces.Discrete(3), None), [[1, 1], [0], [[0, 1]]]),
    *((spaces.OneOf([NAMED, FLOATS]), said) for said in (None, [0], [2, 1], [-1, {"a": 1}], [True, [0, 0]], [1, [0]])),
]
NOT_IN_THE_SPACE: list[tuple[Any, Any]] = [
    (FLOATS, [None, 0]),
    (FLOATS, [np.inf, 0]),
    (FLOATS, [0, -1e300]),
    (spaces.Box(-np.inf, 1, (1,)), [np.inf]),
    (spaces.Box(0, 200, (2,), np.uint8), [201, 0]),
    (spaces.Discrete(2), 2),
    (spaces.Discrete(2), -1),
    (spaces.Discrete(2, start=5), 4),
    (spaces.MultiBinary(2), [2, 0]),
    (spaces.MultiDiscrete([2, 3]), [1, 3]),
    (spaces.MultiDiscrete([2, 3], start=[1, 0]), [0, 0]),
    (spaces.Text(2), "abc"),
    (spaces.Text(3, charset="ab"), "abc"),
    (spaces.Text(3, min_length=1), ""),
    (PAIR, [2, [0, 0]]),
    (spaces.Sequence(spaces.Discrete(2)), [0, 2]),
    (spaces.Sequence(spaces.Discrete(2), stack=True), [0, 2]),
    (GRAPH, [[0, 1], [0], [[0, 2]]]),
    (GRAPH, [[0, 1], [0, 0], [[0, 1]]]),
    (spaces.OneOf([spaces.Discrete(2)]), [0, 2]),
]


@pytest.mark.parametrize(("space", "said"), WRONG_VALUES, ids=repr)
@pytest.mark.parametrize("action", [False, True])
def test_a_value_of_another_shape_or_type_gets_a_sentence(space: Any, said: Any, action: bool) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        values.decoder(space, action=action)(said)


@pytest.mark.parametrize(("space", "said"), NOT_IN_THE_SPACE, ids=repr)
def test_an_action_outside_its_space_gets_a_sentence(space: Any, said: Any) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        values.decoder(space, action=True)(said)


@pytest.mark.parametrize(("space", "said"), NOT_IN_THE_SPACE, ids=repr)
def test_an_observation_outside_its_space_arrives(space: Any, said: Any) -> None:
    values.decoder(space)(over_json(said))


@pytest.mark.parametrize(("space", "said"), NOT_IN_THE_SPACE, ids=repr)
def test_an_action_outside_its_space_gets_a_sentence_in_a_batch_too(space: Any, said: Any) -> None:
    layout, strict = arrays.layout(space), arrays.layout(space, action=True)
    inside, outside = sampled(space, 1, 1)[0], values.decoder(space)(over_json(said))
    batch = arrays.batch_of(layout, [inside, outside])
    request = arrays.read_request(arrays.step_request(arrays.STEP_MANY, 0, 2, layout, batch))
    with pytest.raises(CodecError, match=r"\.$"):
        arrays.read_actions(request, strict)


def test_a_finite_action_beyond_the_bounds_arrives_since_environments_clip_it() -> None:
    assert values.decoder(FLOATS, action=True)([5, -5]).tolist() == [5, -5]


@given(SPACES, SEEDS, st.data())
def test_a_message_cut_short_or_too_long_gets_a_sentence(space: Any, seed: int, data: Any) -> None:
    layout = arrays.layout(space)
    batch = arrays.batch_of(layout, sampled(space, seed, 3))
    message = arrays.step_request(arrays.STEP_MANY, 0, 3, layout, batch)
    wrong = [message + b"\0"]
    if len(message) > 8:
        wrong.append(message[: data.draw(st.integers(0, len(message) - 1))])
    for one in wrong:
        with pytest.raises(CodecError, match=r"\.$"):
            arrays.read_actions(arrays.read_request(one), layout)


@given(st.binary(max_size=60), st.sampled_from([FLOATS, NAMED, GRAPH, spaces.Text(3), spaces.Box(0, 1, (3,), bool)]))
def test_random_bytes_are_read_or_get_a_sentence(data: bytes, space: Any) -> None:
    layout = arrays.layout(space, action=True)
    reads = (
        lambda: arrays.read_actions(arrays.read_request(data), layout),
        lambda: arrays.read_reset(arrays.read_request(data)),
        lambda: arrays.read_steps(data, layout),
        lambda: arrays.read_reset_reply(data, layout),
        lambda: exact.from_text(data),
    )
    for read in reads:
        try:
            read()
        except CodecError as error:
            assert str(error).endswith(".")


@pytest.mark.parametrize("count", [0, 2, arrays.MAX_STEPS + 1])
def test_a_count_of_steps_that_does_not_fit_its_kind_gets_a_sentence(count: int) -> None:
    kind = arrays.STEP if count == 2 else arrays.STEP_MANY
    with pytest.raises(CodecError, match="not for"):
        arrays.read_request(struct.pack("<BxHI", kind, 0, count))


@pytest.mark.parametrize(
    ("space", "value"),
    [
        (FLOATS, np.zeros(3, np.float32)),
        (FLOATS, np.zeros((1, 2), np.float32)),
        (FLOATS, [[1], [1, 2]]),
        (FLOATS, np.array(["a", "b"])),
        (FLOATS, None),
        (BYTES, np.array([1.5, 2])),
        (BYTES, np.array([256, 0])),
        (BYTES, np.array([-1, 0])),
        (spaces.Discrete(2), np.array([1])),
        (spaces.Discrete(2), "a"),
        (spaces.Discrete(2), 2**70),
        (NAMED, {"b": 1}),
        (NAMED, 3),
        (PAIR, (1,)),
    ],
    ids=repr,
)
def test_an_observation_that_its_space_cannot_hold_gets_a_sentence(space: Any, value: Any) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        arrays.batch_of(arrays.layout(space), [value])


@pytest.mark.parametrize("value", [[0.5, 1.0], np.array([0.5, 1.0]), np.array([0.5, 1.0], np.float16)])
def test_an_observation_of_another_kind_of_float_takes_the_dtype_of_its_space(value: Any) -> None:
    layout = arrays.layout(FLOATS)
    assert same(layout.rows(arrays.batch_of(layout, [value]), 1)[0], np.array([0.5, 1.0], np.float32))


def test_an_observation_is_copied_since_environments_use_their_arrays_again() -> None:
    layout = arrays.layout(FLOATS)
    value = np.zeros(2, np.float32)
    batch = arrays.batch_of(layout, [value])
    value[:] = 7
    assert batch.tolist() == [[0, 0]]


def test_an_action_of_a_message_can_be_written_into() -> None:
    layout = arrays.layout(FLOATS, action=True)
    message = arrays.step_request(arrays.STEP, 0, 1, layout, arrays.batch_of(layout, [[0, 0]]))
    action = layout.rows(arrays.read_actions(arrays.read_request(message), layout), 1)[0]
    action += 1
    assert action.tolist() == [1, 1]


# --- replies ---


@given(SPACES, SEEDS, st.integers(1, 4))
def test_the_results_of_steps_travel(space: Any, seed: int, count: int) -> None:
    layout = arrays.layout(space)
    rows = sampled(space, seed, count)
    rewards = np.array([np.inf, -0.5, np.nan, 1e-300][:count])
    ends = np.array([True, False, True, False][:count])
    infos = [(count - 1, {"a": np.float32(0.5), "lives": 3})]
    sent = arrays.StepRows(arrays.batch_of(layout, rows), rewards, ends, ~ends, [(0, {}), *infos])
    found = arrays.read_steps(arrays.steps_reply(arrays.STEP_MANY, 3, layout, sent), layout)
    assert all(map(same, layout.rows(found.observations, count), rows))
    assert same(found.rewards, rewards)
    assert same(found.terminated, ends)
    assert same(found.truncated, ~ends)
    assert same(found.infos, infos)


@given(SPACES, SEEDS)
def test_the_first_observations_travel(space: Any, seed: int) -> None:
    layout = arrays.layout(space)
    rows = sampled(space, seed, 2)
    reply = arrays.reset_reply(1, layout, 2, arrays.batch_of(layout, rows), [(0, {"prob": 1.0})])
    batch, infos = arrays.read_reset_reply(reply, layout)
    assert all(map(same, layout.rows(batch, 2), rows))
    assert infos == [(0, {"prob": 1.0})]


def test_only_the_rows_that_were_stepped_are_sent() -> None:
    space = spaces.Dict({"a": FLOATS, "b": spaces.Text(3), "c": spaces.Tuple([spaces.Discrete(9)])})
    layout = arrays.layout(space)
    rows = sampled(space, 5, 4)
    flags = np.zeros(3, bool)
    sent = arrays.StepRows(arrays.batch_of(layout, rows), np.zeros(3), flags, flags, [])
    found = arrays.read_steps(arrays.steps_reply(arrays.STEP_MANY, 3, layout, sent), layout)
    assert all(map(same, layout.rows(found.observations, 3), rows[:3]))


@given(SPACES, SEEDS)
def test_a_batch_of_a_vector_is_sent_as_a_whole(space: Any, seed: int) -> None:
    layout = arrays.layout(space)
    rows = sampled(space, seed, 3)
    batch = layout.empty(5)
    layout.put_batch(batch, 0, arrays.batch_of(layout, rows[1:]), 2)
    layout.put_batch(batch, 2, arrays.batch_of(layout, rows), 3)
    assert all(map(same, layout.rows(batch, 5), [*rows[1:], *rows]))


def test_a_reset_has_a_seed_and_options() -> None:
    options = {"mask": np.array([True, False]), "low": -0.1}
    seed, found = arrays.read_reset(arrays.read_request(arrays.reset_request(0, [1, None], options)))
    assert seed == [1, None]
    assert same(found, options)
    assert arrays.read_reset(arrays.read_request(struct.pack("<BxHI", arrays.RESET, 0, 0))) == (None, None)


@pytest.mark.parametrize("said", [[], {"seed": -1}, {"seed": "a"}, {"seed": True}, {"options": 3}, {"x": 1}, "{"])
def test_a_wrong_reset_gets_a_sentence(said: Any) -> None:
    body = said if isinstance(said, str) else json.dumps(said)
    with pytest.raises(CodecError, match=r"\.$"):
        arrays.read_reset(arrays.read_request(struct.pack("<BxHI", arrays.RESET, 0, 0) + body.encode()))


# --- infos ---


class UnknownObject:
    """An object that no codec knows."""


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
    st.binary(max_size=5),
    st.floats(width=32).map(np.float32),
    st.integers(-9, 9).map(np.int16),
    st.booleans().map(np.bool_),
)
ARRAYS = st.sampled_from(
    [
        np.arange(6, dtype=np.int32).reshape(2, 3),
        np.array([np.nan, np.inf], np.float16),
        np.array(["a", "bc"]),
        np.array([1 + 2j]),
        np.array(3.5),
        np.zeros((0, 2)),
        np.array([None, "x", {"a": 1}], object),
    ]
)
INFOS = st.recursive(
    st.one_of(SCALARS, ARRAYS),
    lambda inner: st.one_of(
        st.lists(inner, max_size=3),
        st.lists(inner, max_size=3).map(tuple),
        st.dictionaries(st.one_of(st.text(max_size=3), st.just("$tuple"), st.integers()), inner, max_size=3),
    ),
    max_leaves=8,
)


@given(INFOS)
def test_infos_come_back_as_they_were(info: Any) -> None:
    assert same(exact.from_text(exact.to_text(info)), info)


@given(INFOS)
def test_infos_are_json_for_gymies_clients(info: Any) -> None:
    text = values.to_text(info)
    json.loads(text, parse_constant=pytest.fail)


@pytest.mark.parametrize("write", [values.to_text, exact.to_text])
def test_of_an_object_that_cannot_be_sent_the_name_of_its_class_arrives(write: Any) -> None:
    assert json.loads(write({"thing": UnknownObject(), "in a list": [UnknownObject]})) == {
        "thing": "UnknownObject",
        "in a list": ["type"],
    }


@pytest.mark.parametrize("write", [values.to_text, exact.to_text])
def test_a_dict_that_contains_itself_is_sent_to_some_depth(write: Any) -> None:
    info: dict[str, Any] = {}
    info["self"] = info
    assert json.loads(write(info))


@pytest.mark.parametrize(
    "said",
    [
        '{"$array": ["O", [1], ""]}',
        '{"$array": ["<f8", [2], "AAAA"]}',
        '{"$array": ["<f8", [-1], ""]}',
        '{"$array": 3}',
        '{"$scalar": ["<f8", [], ""]}',
        '{"$tuple": 3}',
        '{"$set": [[1]]}',
        '{"$dict": [[{"$dict": []}, 1]]}',
        '{"$objects": [[5], [1]]}',
        '{"$nothing": 1}',
        '{"$float": "many"}',
        "[" * 100_000,
        "\xff",
        "",
    ],
    ids=lambda said: said[:20],
)
def test_wrong_infos_get_a_sentence(said: str) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        exact.from_text(said)


# --- pictures ---


@pytest.mark.parametrize("shape", [(20, 30, 3), (20, 30, 4), (20, 30), (20, 30, 1), (1, 1, 3)])
def test_a_picture_travels_as_png(shape: Any) -> None:
    picture = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    said = over_json(values.picture(picture))
    assert base64.b64decode(said["png"]).startswith(b"\x89PNG")
    assert same(values.rendered(said), picture)


@pytest.mark.parametrize(
    "found",
    [None, "a line\nof text", [np.zeros((2, 2, 3), np.uint8)] * 2, np.eye(3), np.zeros((0, 2, 3), np.uint8), []],
    ids=lambda found: type(found).__name__,
)
def test_other_results_of_render_travel_too(found: Any) -> None:
    assert same(values.rendered(over_json(values.picture(found))), found)


@pytest.mark.parametrize("found", [UnknownObject(), 3, np.array(["a"])])
def test_a_result_that_is_no_picture_gets_a_sentence(found: Any) -> None:
    with pytest.raises(CodecError, match="cannot be sent"):
        values.picture(found)


@pytest.mark.parametrize("said", [3, {}, {"png": "AAAA", "shape": [1]}, {"array": [1], "dtype": "O", "shape": [2]}])
def test_an_answer_that_is_no_picture_gets_a_sentence(said: Any) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        values.rendered(said)
