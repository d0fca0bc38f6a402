"""Whatever `render()` returns: a scene that can be sent and drawn, or a SceneError with a sentence."""

from __future__ import annotations

import json
import random
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.pictures.assets import Assets
from hippodrome.trial.pictures.raster import Raster
from hippodrome.trial.pictures.scene import Scene, SceneError, as_scene, images_of
from hippodrome.trial.pictures.scene_encoder import SceneDecoder, SceneEncoder
from hippodrome.trial.pictures.scene_object import TYPES
from testing.exploration import examples

RASTER = Raster(SceneSection(width=40, height=30), Assets())

_NUMBERS = st.floats() | st.integers() | st.sampled_from([np.float32(0.5), np.int64(3), np.array(1.5), True, 10**400])
_ODD = st.none() | st.text(max_size=5) | st.binary(max_size=3) | st.lists(_NUMBERS, max_size=3) | st.just(object())
_POINTS = st.lists(st.tuples(_NUMBERS, _NUMBERS) | _ODD, max_size=6) | st.just(np.ones((4, 2)))
_COLORS = st.sampled_from(["#fff", "#ff000080", "red", "RED", "rgb(1,2,3)", "#12", "javascript:x", ""])
_FIELDS = {
    **dict.fromkeys(("x", "y", "width", "height", "radius", "angle", "depth", "alpha", "size"), _NUMBERS | _ODD),
    **dict.fromkeys(("color", "outline"), _COLORS | _ODD),
    **{"points": _POINTS | _ODD, "origin": _POINTS | st.just((0.5, 0.5)), "tween": _NUMBERS, "outline_width": _NUMBERS},
    **{
        "text": st.text(max_size=20) | _NUMBERS,
        "font": st.sampled_from(["Arial", "a;b", ""]),
        "frame": _NUMBERS | _ODD,
    },
    **{"image": st.sampled_from(["a.png", "../../x", ""]) | _ODD, "permanent": _NUMBERS, "remove": st.booleans()},
    "fill_below": st.booleans(),
}
_GOOD = {
    **{key: st.integers(-5, 50) for key in ("x", "y", "depth", "angle")},
    **{key: st.integers(0, 20) for key in ("width", "height", "radius")},
    **{"points": st.just([(0, 0), (1, 1), (0, 1)]), "text": st.just("hi"), "image": st.just("a")},
}
_OBJECTS = (
    st.fixed_dictionaries(
        {"id": st.sampled_from(["a", "b", "\ud800", 7, "", None]), "type": st.sampled_from([*TYPES, "blob", None, 3])},
        optional=_FIELDS,
    )
    | st.fixed_dictionaries({"id": st.sampled_from(["a", "b"]), "type": st.sampled_from([*TYPES]), **_GOOD})
    | st.dictionaries(st.text(max_size=3) | st.integers(), _ODD, max_size=3)
    | _ODD
)


@given(st.lists(st.lists(_OBJECTS, max_size=5) | st.fixed_dictionaries({"objects": _ODD, "hud": _ODD}), max_size=4))
def test_whatever_render_returns_is_a_scene_or_an_error_with_a_sentence(pictures: list[Any]) -> None:
    before: Scene | None = None
    encoder, decoder = SceneEncoder(), SceneDecoder()
    for number, picture in enumerate(pictures):
        try:
            scene = as_scene(picture, before)
        except SceneError as error:
            assert str(error).startswith("render()")
            continue
        assert all(isinstance(sentence, str) and sentence for sentence in scene.problems)
        json.dumps(dict(scene.objects), allow_nan=False)
        decoder.decode(encoder.encode(scene, number))
        assert RASTER.draw(scene).shape == (30, 40, 3)
        before = scene


_SPRITE = {"type": "sprite", "x": 0.5, "y": 0, "image": "a"}
_CIRCLE = {"type": "circle", "x": 0.5, "y": 0, "radius": 2, "color": "#ffffff", "depth": 1}
_TEXT = {"type": "text", "x": 0.5, "y": 0, "text": "1", "tween": 30}
_ODDER = {"type": "circle", "x": 0.5, "y": 0, "radius": 2, "alpha": 0.5, "opacity": 0.25}
_VALUES = {
    **{key: [0, 0.5, 0.25, "left", float("nan"), None] for key in ("x", "y", "alpha", "opacity", "depth", "tween")},
    **{"color": ["#ffffff", "#000000", "no"], "text": ["1", 1, 2, ""], "image": ["a", "b.png"], "radius": [2, [2]]},
    **{"id": ["a", "b", 3], "type": ["circle", "sprite"], "points": [[(0, 0), (1, 1)]]},
}


def test_without_permanent_objects_the_scene_before_makes_no_difference() -> None:
    for seed in range(examples(200)):
        _check_changes(random.Random(seed))


def _check_changes(chance: random.Random) -> None:
    """Show three objects while their fields change; each scene must be the same as without the scene before it."""
    kinds = (_SPRITE, _CIRCLE, _TEXT, _ODDER)
    objects: list[dict[str, Any]] = [{"id": name, **chance.choice(kinds)} for name in "abc"]
    before = None
    encoder, decoder = SceneEncoder(), SceneDecoder()
    for number in range(30):
        changed = dict(chance.choice(objects))
        key = chance.choice([*changed] if chance.random() < 0.9 else [*_VALUES])
        changed[key] = chance.choice(_VALUES[key])
        picture = [changed if each["id"] == changed["id"] else dict(each) for each in objects]
        scene, alone = as_scene(picture, before), as_scene(picture)
        assert _as_json(scene.objects) == _as_json(alone.objects)
        assert (sorted(scene.problems), images_of(scene)) == (sorted(alone.problems), images_of(alone))
        decoder.decode(encoder.encode(scene, number))
        assert decoder.objects == scene.objects
        assert list(decoder.objects) == list(scene.objects)
        before = scene
        if not scene.problems:
            objects = picture


def _as_json(objects: Any) -> str:
    """As JSON, which keeps the order of the objects and of their fields."""
    return json.dumps({name: dict(each) for name, each in objects.items()})
