"""What is sent of scenes: only what changed, and a client that takes all of it has the scene."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.pictures import scene_encoder
from hippodrome.trial.pictures.scene import Scene, as_scene
from hippodrome.trial.pictures.scene_encoder import HEADER, PACKED_SCENE, SCENE, SceneDecoder, SceneEncoder, changes

BALL = {"id": "ball", "type": "circle", "x": 0.5, "y": 0.25, "radius": 10, "color": "#ff0000"}
WALL = {"id": "wall", "type": "rectangle", "x": 0, "y": 0, "width": 5, "height": 400}


def test_the_first_scene_is_sent_whole() -> None:
    scene = as_scene({"objects": [BALL, WALL], "hud": "3"})
    assert changes(None, scene) == {"new": True, "set": scene.objects, "hud": "3"}


def test_only_the_fields_that_changed_are_sent() -> None:
    first = as_scene([WALL, BALL | {"alpha": 0.5}])
    second = as_scene([WALL, BALL | {"x": 0.6}], first)
    assert changes(first, second) == {"set": {"ball": {"x": 0.6, "alpha": None}}}


def test_nothing_is_sent_of_a_scene_that_did_not_change() -> None:
    first = as_scene([WALL, BALL])
    assert changes(first, as_scene([WALL, BALL], first)) == {}


def test_an_object_that_is_gone_is_named_and_a_new_one_is_whole() -> None:
    first = as_scene([BALL])
    second = as_scene([WALL], first)
    assert changes(first, second) == {"gone": ["ball"], "set": {"wall": second.objects["wall"]}}


def test_the_order_is_sent_if_it_changed() -> None:
    first = as_scene([BALL, WALL])
    assert changes(first, as_scene([WALL, BALL], first)) == {"order": ["wall", "ball"]}


def test_an_encoder_that_forgets_sends_the_scene_whole_again() -> None:
    encoder, scene = SceneEncoder(), as_scene([BALL])
    whole = encoder.encode(scene, 1)
    assert json.loads(encoder.encode(scene, 2)[HEADER.size :]) == {}
    encoder.forget()
    assert encoder.encode(scene, 1) == whole


def test_large_scenes_are_deflated() -> None:
    many = as_scene([BALL | {"id": f"ball{n}"} for n in range(200)])
    data = SceneEncoder().encode(many, 7)
    assert HEADER.unpack_from(data) == (PACKED_SCENE, 7)
    assert len(data) < 4_000
    assert HEADER.unpack_from(SceneEncoder().encode(as_scene([BALL]), 7)) == (SCENE, 7)


_OBJECTS = st.fixed_dictionaries(
    {"id": st.sampled_from("abcdé\u2028"), "type": st.just("circle"), "x": st.sampled_from([0, 0.5]), "y": st.just(0)}
    | {"radius": st.integers(1, 2)},
    optional={"alpha": st.sampled_from([0.5, 1]), "tween": st.just(9), "permanent": st.booleans()},
) | st.fixed_dictionaries(
    {
        "id": st.sampled_from("abcd"),
        "type": st.just("text"),
        "x": st.just(1),
        "y": st.just(1),
        "text": st.text(max_size=3),
    }
)


@given(st.lists(st.tuples(st.lists(_OBJECTS, max_size=6), st.text(max_size=3), st.booleans()), max_size=8))
def test_a_client_has_each_scene_after_its_message(given_scenes: list[tuple[list[dict[str, Any]], str, bool]]) -> None:
    encoder, decoder, before = SceneEncoder(), SceneDecoder(), None
    for number, (objects, hud, forgotten) in enumerate(given_scenes):
        scene: Scene = as_scene({"objects": objects, "hud": hud}, before)
        if forgotten:
            encoder.forget()
        assert decoder.decode(encoder.encode(scene, number)) == number
        assert list(decoder.objects.items()) == list(scene.objects.items())
        assert decoder.hud == hud
        before = scene


def test_clients_with_the_same_scene_get_the_same_bytes_and_a_later_client_gets_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    packed: list[Scene] = []

    def count_changes(before: Scene | None, scene: Scene) -> dict[str, Any]:
        packed.append(scene)
        return changes(before, scene)

    monkeypatch.setattr(scene_encoder, "changes", count_changes)
    one, other, late = SceneEncoder(), SceneEncoder(), SceneEncoder()
    first, second = as_scene([BALL]), as_scene([{**BALL, "x": 0.25}])
    assert one.encode(first, 1) == other.encode(first, 1)
    assert len(packed) == 1
    seconds = one.encode(second, 2), late.encode(second, 2), other.encode(second, 2)
    assert seconds[0] == seconds[2] != seconds[1]
    decoder = SceneDecoder()
    decoder.decode(seconds[1])
    assert decoder.objects["ball"]["x"] == 0.25
