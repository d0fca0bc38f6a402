"""What `render()` may return as objects, and the sentences about objects that cannot be drawn."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest

from hippodrome.trial.pictures.frames import FrameError
from hippodrome.trial.pictures.reader import as_picture
from hippodrome.trial.pictures.scene import MAX_OBJECTS, MAX_TEXT_IN_ALL, Scene, SceneError, as_scene, images_of
from hippodrome.trial.pictures.scene_object import MAX_POINTS

BALL = {"id": "ball", "type": "circle", "x": 0.5, "y": 0.25, "radius": 10, "color": "#ff0000"}


def problem(**fields: Any) -> str:
    """Return the one sentence about a scene whose only object is a ball with other fields; the ball is not drawn."""
    scene = as_scene([BALL | fields])
    assert not scene.objects
    (sentence,) = scene.problems
    return sentence


def test_a_list_of_objects_is_a_scene() -> None:
    scene = as_scene([BALL])
    assert scene.objects == {"ball": {"type": "circle", "x": 0.5, "y": 0.25, "radius": 10, "color": "#ff0000"}}
    assert not scene.problems


def test_a_map_also_has_a_text_for_the_hud() -> None:
    scene = as_scene({"objects": [BALL], "hud": "Time left: 3"})
    assert (list(scene.objects), scene.hud) == (["ball"], "Time left: 3")


@dataclasses.dataclass
class Sprite:
    """A sprite with Interactive Gym's names of fields."""

    uuid: str
    x: float
    y: float
    height: int
    width: int
    image_name: str | None = None
    frame: str | int | None = None
    object_size: int | None = None
    angle: int | None = None
    depth: int = 1
    animation: str | None = None
    object_type: str = "sprite"
    tween: bool = False
    tween_duration: int = 50
    permanent: bool = False

    def as_dict(self) -> dict[str, Any]:
        return dataclasses.asdict(self)


@pytest.mark.parametrize("form", [lambda cook: cook, Sprite.as_dict])
def test_interactive_gyms_words_and_objects_are_understood(form: Any) -> None:
    cook = Sprite("cook", 0.1, 0.2, 45, 40, image_name="chefs", frame="EAST.png", tween=True, tween_duration=75)
    scene = as_scene([form(cook)])
    assert scene.objects["cook"] == {
        **{"type": "sprite", "x": 0.1, "y": 0.2, "image": "chefs", "frame": "EAST.png"},
        **{"width": 40, "height": 45, "depth": 1, "tween": 75},
    }
    assert not scene.problems
    assert images_of(scene) == {"chefs"}


def test_numbers_of_numpy_become_those_of_json() -> None:
    line = {
        "id": 7,
        "type": "line",
        "points": np.array([[0, 0.123456], [1, 2]], dtype=np.float32),
        "width": np.int64(2),
    }
    scene = as_scene([line, BALL | {"x": np.float32(0.5), "depth": np.int8(3)}])
    assert json.loads(json.dumps(scene.objects["7"])) == {"type": "line", "points": [[0, 0.1235], [1, 2]], "width": 2}
    assert json.loads(json.dumps(scene.objects["ball"]))["depth"] == 3


def test_tween_is_a_number_of_milliseconds_or_true() -> None:
    assert as_scene([BALL | {"tween": 120}]).objects["ball"]["tween"] == 120
    assert as_scene([BALL | {"tween": True}]).objects["ball"]["tween"] == 50
    assert "tween" not in as_scene([BALL | {"tween": False}]).objects["ball"]


# ---- from one scene to the next


def test_a_permanent_object_stays_until_the_episode_ends() -> None:
    ground = {"id": "ground", "type": "rectangle", "x": 0, "y": 0.9, "width": 600, "height": 40, "permanent": True}
    first = as_scene([ground, BALL])
    second = as_scene([BALL | {"x": 0.6}], first)
    third = as_scene([], second)
    assert [list(scene.objects) for scene in (second, third)] == [["ground", "ball"], ["ground"]]
    assert not as_scene([]).objects, "the first scene of an episode has none before it"


def test_permanent_objects_come_first_from_the_beginning() -> None:
    first = as_scene([BALL, BALL | {"id": "wall", "permanent": True}])
    assert list(first.objects) == list(as_scene([BALL], first).objects) == ["wall", "ball"]


def test_permanent_objects_do_not_pile_up_without_end() -> None:
    scene: Scene | None = None
    for number in range(3):
        drops = [BALL | {"id": f"{number}-{index}", "permanent": True} for index in range(MAX_OBJECTS // 2)]
        scene = as_scene(drops, scene)
    assert scene is not None
    assert len(scene.objects) == MAX_OBJECTS
    said = f"the scene has more than {MAX_OBJECTS} objects with those that are permanent; some are left out"
    assert scene.problems == (said,)
    assert as_scene([{"id": "0-0", "remove": True}, BALL], scene).objects.keys() >= {"ball"}, "there is room again"


def test_an_object_that_found_no_room_is_drawn_when_there_is_room() -> None:
    drops = [BALL | {"id": str(index), "permanent": True} for index in range(MAX_OBJECTS - 1)]
    full = as_scene([*drops, BALL])
    crowded = as_scene([BALL | {"id": "last", "permanent": True}, BALL], full)
    assert "ball" not in crowded.objects
    scene = as_scene([{"id": "0", "remove": True}, BALL], crowded)
    assert "ball" in scene.objects
    assert scene.problems == ()


def test_points_of_permanent_objects_do_not_pile_up_without_end() -> None:
    path = {"type": "line", "points": [(0, 0)] * (MAX_POINTS - 1), "color": "red", "permanent": True}
    scene: Scene | None = None
    for number in range(6):
        scene = as_scene([path | {"id": str(number)}], scene)
    assert scene is not None
    assert list(scene.objects) == ["0", "1", "2", "3"]
    again = as_scene([path | {"id": str(number)} for number in range(4)], scene)
    assert (list(again.objects), again.problems) == (list("0123"), ()), "each counts once"


def test_a_permanent_object_can_be_changed_and_removed() -> None:
    first = as_scene([BALL | {"permanent": True}])
    changed = as_scene([BALL | {"permanent": True, "x": 1}], first)
    assert (changed.objects["ball"]["x"], changed.problems) == (1, ())
    assert not as_scene([{"id": "ball", "remove": True}], changed).objects


def test_a_permanent_object_that_is_removed_and_comes_again_in_one_picture_stays() -> None:
    ball = BALL | {"permanent": True}
    again = as_scene([{"id": "ball", "remove": True}, ball], as_scene([ball]))
    assert again.permanent == {"ball"}


def test_an_object_that_did_not_change_is_the_same_one() -> None:
    first = as_scene([dict(BALL), BALL | {"id": "other"}])
    second = as_scene([dict(BALL), BALL | {"id": "other", "x": 0.9}], first)
    assert second.objects["ball"] is first.objects["ball"]
    assert second.objects["other"] is not first.objects["other"]


def test_an_object_that_was_changed_in_place_is_seen() -> None:
    ball, path = dict(BALL), {"id": "path", "type": "line", "points": [[0, 0], [1, 1]]}
    first = as_scene([ball, path])
    ball["x"] = 0.75
    path["points"][0][0] = 0.5  # type: ignore[index]
    second = as_scene([ball, path], first)
    assert (second.objects["ball"]["x"], second.objects["path"]["points"][0]) == (0.75, [0.5, 0])
    assert first.objects["path"]["points"][0] == [0, 0]


def test_an_object_is_checked_again_when_its_number_becomes_an_array() -> None:
    first = as_scene([BALL])
    scene = as_scene([BALL | {"x": np.zeros(3)}], first)
    assert scene.problems == ("the object 'ball' cannot be drawn: its x is no number",)


def test_a_permanent_object_that_comes_again_unchanged_can_become_an_ordinary_one() -> None:
    wall = BALL | {"id": "wall", "permanent": True}
    again = as_scene([wall], as_scene([wall]))
    assert again.permanent == {"wall"}
    assert as_scene([wall | {"permanent": False}], again).permanent == frozenset()


def test_the_last_entry_of_an_id_counts_in_the_next_scene_too() -> None:
    first = as_scene([BALL, BALL | {"x": 0.9, "origin": 3}])
    assert as_scene([BALL], first).objects["ball"]["x"] == 0.5
    removed = as_scene([BALL, {"id": "ball", "remove": True}], first)
    assert list(as_scene([BALL], removed).objects) == ["ball"]


# ---- what is wrong


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"x": float("nan")}, "the object 'ball' cannot be drawn: its x is no finite number (nan)"),
        ({"x": float("inf")}, "the object 'ball' cannot be drawn: its x is no finite number (inf)"),
        ({"x": "left"}, "the object 'ball' cannot be drawn: its x is no number"),
        ({"x": None}, "the object 'ball' has no x, which a circle needs"),
        ({"radius": -1}, "the object 'ball' cannot be drawn: its radius is -1; it must be from 0 to 1e+06"),
        ({"alpha": 2}, "the object 'ball' cannot be drawn: its alpha is 2; it must be from 0 to 1"),
        (
            {"color": "url(x)"},
            "the object 'ball' cannot be drawn: its color is no color: 'url(x)'; write it as '#rrggbb'",
        ),
        ({"tween": 1e9}, "the object 'ball' cannot be drawn: its tween is 1e+09; it must be from 0 to 10000"),
        (
            {"type": "blob"},
            "the object 'ball' has the type 'blob'; there are sprite, line, circle, rectangle, polygon, text",
        ),
        (
            {"type": "polygon", "points": [(0, 0)] * (MAX_POINTS + 1)},
            "the object 'ball' cannot be drawn: its points are 5001; there must be 3 to 5000",
        ),
        (
            {"type": "line", "points": [(0, 0), (1,)]},
            "the object 'ball' cannot be drawn: its points are not pairs of numbers",
        ),
        (
            {"type": "text", "text": "a" * 1001},
            "the object 'ball' cannot be drawn: its text has 1001 characters; at most 1000 are shown",
        ),
    ],
)
def test_an_object_that_cannot_be_drawn_is_left_out_with_a_sentence(fields: dict[str, Any], said: str) -> None:
    assert problem(**fields) == said


class Raises:
    """Its text raises."""

    def __str__(self) -> str:
        raise KeyError("x")


def endless_list() -> list[Any]:
    """Return a list in a list in a list …"""
    inner: list[Any] = []
    for _ in range(100_000):
        inner = [inner]
    return inner


@pytest.mark.parametrize(
    ("fields", "why"), [({"text": Raises()}, "KeyError"), ({"text": endless_list()}, "RecursionError")]
)
def test_an_object_that_raises_is_left_out_with_a_sentence(fields: dict[str, Any], why: str) -> None:
    scene = as_scene([{"id": "words", "type": "text", "x": 0, "y": 0, **fields}, BALL])
    assert list(scene.objects) == ["ball"]
    assert scene.problems == (f"object 1 of render() cannot be read ({why})",)
    with pytest.raises(SceneError, match=rf"a hud that cannot be read \({why}\)"):
        as_scene({"objects": [], "hud": fields["text"]})


def test_beside_a_wrong_object_the_others_are_drawn() -> None:
    scene = as_scene([BALL | {"id": "lost", "x": float("nan")}, BALL])
    assert list(scene.objects) == ["ball"]


def test_an_object_without_an_id_is_drawn_and_remarked() -> None:
    scene = as_scene([{key: value for key, value in BALL.items() if key != "id"}])
    assert len(scene.objects) == 1
    assert scene.problems == ("object 1 of render() (circle) has no id; give each object an id that it keeps",)


def test_of_two_objects_with_one_id_the_later_counts() -> None:
    scene = as_scene([BALL, BALL | {"x": 0.9}])
    assert scene.objects["ball"]["x"] == 0.9
    assert scene.problems == ("two objects have the id 'ball'; the later one counts",)


def test_a_field_that_the_type_does_not_have_is_remarked() -> None:
    scene = as_scene([BALL | {"colour": "#00ff00"}])
    assert list(scene.objects) == ["ball"]
    assert scene.problems == ("the object 'ball' has a field 'colour', which a circle does not have",)


def test_text_keeps_its_markup_and_loses_control_characters() -> None:
    words = {"id": "words", "type": "text", "x": 0, "y": 0, "text": "<b>3 & 4</b>\n\x00\x1bend"}
    assert as_scene([words]).objects["words"]["text"] == "<b>3 & 4</b>\nend"


def test_all_points_of_a_scene_are_bounded() -> None:
    lines = [{"id": n, "type": "line", "points": [(0, 0)] * MAX_POINTS} for n in range(6)]
    scene = as_scene(lines)
    assert len(scene.objects) == 4
    assert scene.problems == ("the scene has more than 20000 points; some objects are left out",)


def text_objects(count: int, letter: str = "x", length: int = 1_000, **more: Any) -> list[dict[str, Any]]:
    return [{"id": f"t{n}", "type": "text", "x": 0.5, "y": 0.5, "text": letter * length, **more} for n in range(count)]


TOO_MUCH_TEXT = ("the scene's texts have more than 100000 characters; some are left out",)


def test_a_scene_has_so_many_characters_in_all_and_goes_on_without_the_others() -> None:
    most = MAX_TEXT_IN_ALL // 1_000
    scene = as_scene([*text_objects(2_000 - 1), BALL])
    assert list(scene.objects) == [*(f"t{n}" for n in range(most)), "ball"]
    assert scene.problems == TOO_MUCH_TEXT
    again = as_scene([*text_objects(2_000 - 1), BALL], scene)
    assert (again.objects, again.problems) == (scene.objects, TOO_MUCH_TEXT)
    other = as_scene([*text_objects(2_000 - 1, "y"), BALL], again)
    assert list(other.objects) == list(scene.objects)
    assert other.objects["t0"]["text"] == "y" * 1_000


def test_texts_that_change_all_the_time_are_not_too_many() -> None:
    scene = as_scene(text_objects(90))
    for letter in "yzabcdefgh":
        scene = as_scene(text_objects(90, letter), scene)
        assert (len(scene.objects), scene.problems) == (90, ())
    fewer = as_scene(text_objects(10), scene)
    assert as_scene([*text_objects(100), BALL], fewer).problems == ()


def test_texts_that_grow_are_too_many_at_last() -> None:
    scene = as_scene(text_objects(150, length=10))
    assert scene.problems == ()
    grown = as_scene(text_objects(150, "y"), scene)
    assert (len(grown.objects), grown.problems) == (100, TOO_MUCH_TEXT)


def test_texts_that_stay_count_for_the_limit_too() -> None:
    scene = as_scene(text_objects(90, permanent=True))
    shown = as_scene([{**each, "id": f"more {each['id']}"} for each in text_objects(20)], scene)
    assert len(shown.objects) == 100
    assert shown.permanent == scene.permanent
    assert shown.problems == TOO_MUCH_TEXT
    assert len(as_scene([], shown).objects) == 90


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ([BALL] * (MAX_OBJECTS + 1), "render() returned 2001 objects; a scene has at most 2000"),
        ({"hud": "3"}, "render() returned a map without 'objects'; return a list, or {'objects': […], 'hud': '…'}"),
        ({"objects": 3}, "render() must return a list of objects, not int"),
    ],
)
def test_a_value_that_is_no_scene_is_refused_with_a_sentence(value: Any, said: str) -> None:
    with pytest.raises(SceneError) as refused:
        as_scene(value)
    assert str(refused.value) == said


@pytest.mark.parametrize("item", [3, "ball", None, [1, 2]])
def test_an_item_that_is_no_object_is_left_out_with_a_sentence(item: Any) -> None:
    scene = as_scene([BALL, item])
    assert list(scene.objects) == ["ball"]
    assert scene.problems == (f"object 2 of render() is no map of fields, but {type(item).__name__}",)


# ---- scenes and frames


def test_a_picture_is_a_scene_or_a_frame() -> None:
    assert isinstance(as_picture([BALL]), Scene)
    assert isinstance(as_picture([]), Scene)
    assert isinstance(as_picture(np.zeros((2, 3, 3), np.uint8)), np.ndarray)
    assert isinstance(as_picture([np.zeros((3, 3), np.uint8)]), np.ndarray), "rows of pixels in a list"
    with pytest.raises(FrameError):
        as_picture(None)


def test_objects_without_a_scene_in_config_yml_are_refused_with_a_sentence() -> None:
    with pytest.raises(SceneError, match=r"say in config\.yml how large the picture is, as trial\.scene"):
        as_picture([BALL], scenes=False)
