"""Spaces and values of every kind travel as JSON and by the binary subprotocol, and arrive as they were."""

from __future__ import annotations

import base64
import io
import json
import struct
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from hippodrome.trial.gym import values
from hippodrome.trial.gym.spaces import CodecError, build, describe
from tests.trial.gym.comparing import same
from tests.trial.gym.remote_environments import EVERYTHING

SPACES: list[spaces.Space[Any]] = [
    *EVERYTHING.values(),
    spaces.Tuple([EVERYTHING, spaces.Dict({})]),
    spaces.Box(-1, np.array([[1, np.inf]], np.float16), (1, 2), np.float16),
    spaces.Box(0, 1, (), np.float64),
    spaces.Box(0, 1, (2, 0), np.float32),
    spaces.Box(-(2**62), 2**62, (2,), np.int64),
    spaces.Box(0, 1, (3,), bool),
    spaces.Discrete(9, dtype=np.uint8),
    spaces.Sequence(EVERYTHING["pair"], stack=True),
    spaces.Graph(spaces.Discrete(3), None),
    spaces.OneOf([EVERYTHING, EVERYTHING["graph"]]),
]


def sampled(space: Any, seed: int, count: int) -> list[Any]:
    """Sample `count` values of the space."""
    space.seed(seed)
    with np.errstate(all="ignore"):
        return [space.sample() for _ in range(count)]


def over_json(value: Any) -> Any:
    return json.loads(values.to_text(value))


def over_bytes(value: Any) -> Any:
    return values.from_bytes(values.to_bytes(value))


@pytest.mark.parametrize("space", SPACES, ids=repr)
@pytest.mark.parametrize("travel", [over_json, over_bytes])
def test_a_space_is_built_again_from_its_description(travel: Any, space: Any) -> None:
    built = build(travel(describe(space)))
    assert built == space
    assert all(map(same, sampled(built, 7, 2), sampled(space, 7, 2)))


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_values_travel_as_json(space: Any) -> None:
    for value in sampled(space, 7, 9):
        assert same(values.read(space, over_json(value)), value)


@pytest.mark.parametrize("space", SPACES, ids=repr)
def test_values_travel_as_bytes(space: Any) -> None:
    for value in sampled(space, 7, 9):
        assert same(over_bytes(value), value)
        assert same(values.read(space, over_bytes(value), action=True), value)


# --- the form that Gymie's client reads ---


def test_descriptions_have_gymies_fields() -> None:
    box = over_json(describe(spaces.Box(np.array([-1, -2], np.float32), np.array([1, np.inf], np.float32))))
    fields = {"name": "Box", "shape": [2], "low": [-1.0, -2.0], "high": [1.0, np.inf]}
    assert box.items() >= fields.items()
    assert describe(spaces.Discrete(4)).items() >= {"name": "Discrete", "n": 4}.items()
    assert describe(spaces.MultiBinary(5)) == {"name": "MultiBinary", "n": 5, "shape": [5]}


def test_gymies_own_descriptions_are_built() -> None:
    assert build({"name": "Discrete", "n": 4}) == spaces.Discrete(4)
    said = {"name": "Box", "shape": [2], "low": [-5.0, -5.0], "high": [5.0, 5.0]}
    assert build(said) == spaces.Box(-5, 5, (2,), np.float32)
    assert build({"name": "MultiBinary", "n": 5, "shape": [5]}) == spaces.MultiBinary(5)


def test_infinities_and_nan_are_sent_as_numbers_that_every_reader_of_json_takes() -> None:
    text = values.to_text({"Infinity": [np.inf, -np.inf, np.float32("nan"), 1.5], 'NaN"': "-Infinity"})
    assert text == r'{"Infinity":[1e999,-1e999,null,1.5],"NaN\"":"-Infinity"}'


# --- what is refused ---


class OwnSpace(spaces.Space[Any]):
    """A space that is none of Gymnasium's own."""


@pytest.mark.parametrize(
    "call",
    [
        lambda: describe(OwnSpace()),
        lambda: values.read(OwnSpace(), 1),
        lambda: describe(spaces.Dict({1: spaces.Discrete(2)})),  # type: ignore[dict-item]
    ],
)
def test_a_space_that_cannot_be_sent_gets_a_sentence(call: Any) -> None:
    with pytest.raises(CodecError, match=r"cannot be sent.*\.$"):
        call()


BOX = {"name": "Box", "shape": [2], "low": [0, 0], "high": [1, 1]}


@pytest.mark.parametrize(
    "said",
    [
        None,
        {},
        {"name": "Discreate", "n": 4},
        {"name": ["Box"]},
        {"name": "Discrete", "n": "4"},
        {"name": "Discrete", "n": 4, "dtype": "no such"},
        BOX | {"low": [2, 2]},
        BOX | {"low": [0, 0, 0]},
        BOX | {"shape": [2**62, 2**62], "low": 0, "high": 1},
        {"name": "Dict", "spaces": {"a": 3}},
        {"name": "Graph", "node_space": None},
    ],
    ids=repr,
)
def test_a_wrong_description_gets_a_sentence(said: Any) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        build(said)


FLOATS = spaces.Box(-1, 1, (2,), np.float32)
BYTES = spaces.Box(0, 255, (2,), np.uint8)
PAIR = spaces.Tuple([spaces.Discrete(2), FLOATS])
NAMED = spaces.Dict({"a": spaces.Discrete(2)})
GRAPH = spaces.Graph(spaces.Discrete(3), spaces.Discrete(2))
WRONG_VALUES: list[tuple[Any, Any]] = [
    *(
        (FLOATS, said)
        for said in (None, "1", 1, [1], [1, 2, 3], [[1, 2]], [[1], [1, 2]], ["1", "2"], [{}, 1], [None, 0], {})
    ),
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
    (FLOATS, [np.nan, 0]),
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
def test_a_value_of_another_shape_or_type_gets_a_sentence(space: Any, said: Any) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        values.read(space, said)


@pytest.mark.parametrize(("space", "said"), NOT_IN_THE_SPACE, ids=repr)
def test_an_action_outside_its_space_gets_a_sentence(space: Any, said: Any) -> None:
    values.read(space, said)
    with pytest.raises(CodecError, match=r"\.$"):
        values.read(space, said, action=True)


def test_a_finite_action_beyond_the_bounds_arrives_since_environments_clip_it() -> None:
    assert values.read(FLOATS, [5, -5], action=True).tolist() == [5, -5]


def test_an_action_of_a_message_can_be_written_into() -> None:
    action = values.read(FLOATS, over_bytes(np.zeros(2, np.float32)), action=True)
    action += 1
    assert action.tolist() == [1, 1]


@given(st.binary(max_size=60), st.booleans())
def test_random_bytes_are_read_or_get_a_sentence(data: bytes, header: bool) -> None:
    try:
        values.from_bytes(struct.pack("<I", len(data)) + data if header else data)
    except CodecError as error:
        assert str(error).endswith(".")


@pytest.mark.parametrize(
    "said",
    [
        '{"$array": ["O", [1]]}',
        '{"$array": ["<f8", [2]]}',
        '{"$array": ["<f8", [-1]]}',
        '{"$array": 3}',
        '{"$tuple": 3}',
        '{"$dict": [{"$dict": []}, 1]}',
        "[" * 100_000,
        "",
    ],
    ids=lambda said: said[:20],
)
def test_a_wrong_message_gets_a_sentence(said: str) -> None:
    with pytest.raises(CodecError, match=r"\.$"):
        values.from_bytes(struct.pack("<I", len(said)) + said.encode())


# --- infos ---


class UnknownObject:
    """An object that no codec knows."""


SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=5),
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
    assert same(over_bytes(info), info)


@given(INFOS)
def test_infos_are_json_for_gymies_clients(info: Any) -> None:
    json.loads(values.to_text(info), parse_constant=pytest.fail)


@pytest.mark.parametrize("travel", [over_json, over_bytes])
def test_of_an_object_that_cannot_be_sent_the_name_of_its_class_arrives(travel: Any) -> None:
    info = {"thing": UnknownObject(), "in a list": [UnknownObject]}
    assert travel(info) == {"thing": "UnknownObject", "in a list": ["type"]}


@pytest.mark.parametrize("travel", [over_json, over_bytes])
def test_a_dict_that_contains_itself_is_sent_to_some_depth(travel: Any) -> None:
    info: dict[str, Any] = {}
    info["self"] = info
    assert travel(info)["self"]["self"]


# --- pictures ---


@pytest.mark.parametrize("shape", [(20, 30, 3), (20, 30, 4), (20, 30), (20, 30, 1), (1, 1, 3)])
def test_a_picture_travels_as_png(shape: Any) -> None:
    picture = np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    said = over_json(values.picture(picture))
    assert said["shape"] == list(shape)
    with Image.open(io.BytesIO(base64.b64decode(said["png"])), formats=["PNG"]) as image:
        assert same(np.array(image, np.uint8).reshape(shape), picture)


def test_other_results_of_render_travel_too() -> None:
    assert over_json(values.picture([None, "text"])) == [None, "text"]
    assert over_json(values.picture(np.eye(1))) == {"array": [[1.0]], "dtype": "float64", "shape": [1, 1]}


@pytest.mark.parametrize("rendered", [UnknownObject(), 3, np.array(["a"])])
def test_a_result_that_cannot_be_sent_gets_a_sentence(rendered: Any) -> None:
    with pytest.raises(CodecError, match="cannot be sent"):
        values.picture(rendered)
