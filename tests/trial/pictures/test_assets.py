"""The images of a project: which files count, what their atlases say, and the sentences about files that cannot be used."""

from __future__ import annotations

import io
import json
import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.pictures import assets
from hippodrome.trial.pictures.assets import Assets
from hippodrome.trial.pictures.raster import Raster
from hippodrome.trial.pictures.scene import as_scene


def image(width: int = 4, height: int = 2, color: str = "red", form: str = "PNG") -> bytes:
    out = io.BytesIO()
    Image.new("RGB", (width, height), color).save(out, form)
    return out.getvalue()


def load_files(tmp_path: Path, **files: bytes | str | dict[str, Any]) -> Assets:
    for name, content in files.items():
        path = tmp_path / "assets" / name.replace("__", "/").replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(
            content
            if isinstance(content, bytes)
            else (json.dumps(content) if isinstance(content, dict) else content).encode()
        )
    return assets.load(tmp_path, "assets")


def problem(tmp_path: Path, **files: bytes | str | dict[str, Any]) -> str:
    found = load_files(tmp_path, **files)
    assert not found.by_name
    (sentence,) = found.problems
    return sentence


def test_images_are_called_by_their_path_without_its_extension(tmp_path: Path) -> None:
    found = load_files(tmp_path, ball_png=image(), cooks__red_webp=image(form="WEBP"), sky_jpg=image(form="JPEG"))
    assert list(found.by_name) == ["ball", "cooks/red", "sky"]
    assert found.by_name["ball"].size == (4, 2)
    assert not found.problems


def test_an_image_has_both_forms_of_its_name(tmp_path: Path) -> None:
    """macOS may store "Ü" as two characters; agents write one, or list the folder themselves."""
    (tmp_path / "assets").mkdir()
    stored, written = (unicodedata.normalize(form, "Übung") for form in ("NFD", "NFC"))
    (tmp_path / "assets" / f"{stored}.png").write_bytes(image())
    found = assets.load(tmp_path, "assets")
    assert found.by_name.keys() == {stored, written}
    assert {each["name"] for each in found.table()} == {stored, written}
    assert not found.problems


def test_a_project_without_the_folder_has_no_images(tmp_path: Path) -> None:
    assert assets.load(tmp_path, "assets") == Assets()


def test_the_same_bytes_have_the_same_hash(tmp_path: Path) -> None:
    found = load_files(tmp_path, a_png=image(), b_png=image(), c_png=image(color="blue"))
    a, b, c = found.table()
    assert a["hash"] == b["hash"] != c["hash"]
    assert a["bytes"] == len(found.by_name["a"].packed)


FRAME = {"frame": {"x": 1, "y": 0, "w": 2, "h": 2}}


@pytest.mark.parametrize(
    "atlas",
    [
        {"frames": {"EAST.png": FRAME}},
        {"frames": [{"filename": "EAST.png", **FRAME}]},
        {"textures": [{"frames": [{"filename": "EAST.png", **FRAME}]}]},
    ],
)
def test_an_atlas_of_texturepacker_or_phaser_names_frames(tmp_path: Path, atlas: dict[str, Any]) -> None:
    found = load_files(tmp_path, cook_png=image(), cook_json=atlas)
    assert found.by_name["cook"].frames == {"EAST.png": (1, 0, 2, 2)}


def test_frames_of_one_size_are_counted_row_by_row(tmp_path: Path) -> None:
    sheet = {"frameWidth": 2, "frameHeight": 1, "animations": {"walk": {"frames": [0, 3], "frameRate": 4}}}
    cook = load_files(tmp_path, cook_png=image(), cook_json=sheet).by_name["cook"]
    assert cook.frames == {"0": (0, 0, 2, 1), "1": (2, 0, 2, 1), "2": (0, 1, 2, 1), "3": (2, 1, 2, 1)}
    assert cook.animations["walk"].frames == ("0", "3")


@pytest.mark.parametrize(
    ("files", "said"),
    [
        ({"cook_svg": "<svg/>"}, "assets/cook.svg is no PNG, JPEG or WebP image; sprites show only these"),
        ({"cook_png": b"<svg/>"}, "assets/cook.png is no PNG, JPEG or WebP image, or is broken"),
        ({"cook_png": image(form="GIF")}, "assets/cook.png is no PNG, JPEG or WebP image, or is broken"),
        ({"cook_png": image(5000, 1)}, "assets/cook.png has 5000 x 1 pixels; at most 4096 x 4096 are shown"),
        ({"cook_png": bytes(5 * 2**20)}, "assets/cook.png has 5 MB; a file has at most 4 MB"),
        ({"cook_png": image(), "cook_json": "{"}, "assets/cook.png cannot be shown: cook.json beside it is no JSON"),
        (
            {"cook_png": image(), "cook_json": {"frames": {"a": {"frame": {"x": 3, "y": 0, "w": 2, "h": 2}}}}},
            "assets/cook.png cannot be shown: cook.json beside it has the frame 'a' outside of the image",
        ),
        (
            {"cook_png": image(), "cook_json": {"frames": {"a": FRAME}, "animations": {"walk": ["b"]}}},
            "assets/cook.png cannot be shown: cook.json beside it has the animation 'walk' with a frame 'b' that is not there",
        ),
    ],
)
def test_a_file_that_cannot_be_used_is_named_with_the_reason(tmp_path: Path, files: dict[str, Any], said: str) -> None:
    assert problem(tmp_path, **files) == said


@pytest.mark.parametrize("form", ["PNG", "JPEG", "WEBP"])
def test_an_image_that_was_cut_off_is_named(tmp_path: Path, form: str) -> None:
    whole = io.BytesIO()
    Image.effect_noise((64, 64), 90).convert("RGB").save(whole, form)
    content = whole.getvalue()
    said = problem(tmp_path, **{f"ball_{form.lower()}": content[: len(content) // 2]})
    assert said == f"assets/ball.{form.lower()} is no PNG, JPEG or WebP image, or is broken"


def test_a_link_out_of_the_folder_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "secret.png").write_bytes(image())
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets" / "secret.png").symlink_to(tmp_path / "secret.png")
    assert assets.load(tmp_path, "assets") == Assets()


def test_all_images_together_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "MAX_ASSETS", 2)
    found = load_files(tmp_path, a_png=image(), b_png=image(), c_png=image())
    assert list(found.by_name) == ["a", "b"]
    assert found.problems == (
        "assets: more than 2 images, 20 MB or 64 megapixels; assets/c.png and all after it are not shown",
    )


def test_the_pixels_of_all_images_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "MAX_PIXELS_IN_ALL", 8)
    assert list(load_files(tmp_path, a_png=image(), b_png=image()).by_name) == ["a"]


# ---- drawn on the server


def raster_of(found: Assets = Assets()) -> Raster:  # noqa: B008 - it never changes
    return Raster(SceneSection(width=100, height=50, pixel_art=True), found)


def pixel(picture: Any, x: int, y: int) -> str:
    return "#" + bytes(picture[y, x]).hex()


def test_the_server_draws_every_type_of_object() -> None:
    picture = raster_of().draw(
        as_scene(
            [
                {"id": 1, "type": "circle", "x": 0.1, "y": 0.2, "radius": 4, "color": "#ff0000"},
                {"id": 2, "type": "rectangle", "x": 0.2, "y": 0, "width": 10, "height": 10, "color": "#00ff00"},
                {"id": 3, "type": "polygon", "points": [(0.4, 0), (0.5, 0), (0.5, 0.4)], "color": "#0000ff"},
                {
                    "id": 4,
                    "type": "line",
                    "points": [(0, 0.5), (1, 0.5)],
                    "width": 3,
                    "fill_below": True,
                    "color": "#00ffff",
                },
                {"id": 5, "type": "text", "x": 0.6, "y": 0, "text": "M", "size": 20},
            ]
        )
    )
    assert picture.shape == (50, 100, 3)
    spots = {(10, 10): "#ff0000", (25, 5): "#00ff00", (48, 5): "#0000ff", (50, 40): "#00ffff", (99, 0): "#ffffff"}
    assert {spot: pixel(picture, *spot) for spot in spots} == spots
    assert (picture[:22, 60:80] < 100).all(axis=2).any(), "letters"


def test_depth_decides_what_covers_what_then_the_order() -> None:
    box = {"type": "rectangle", "x": 0, "y": 0, "width": 10, "height": 10}
    low, high = box | {"id": 1, "depth": 2, "color": "#ff0000"}, box | {"id": 2, "depth": 1, "color": "#00ff00"}
    assert pixel(raster_of().draw(as_scene([low, high])), 5, 5) == "#ff0000"
    assert pixel(raster_of().draw(as_scene([low | {"depth": 1}, high])), 5, 5) == "#00ff00"


def test_the_server_draws_frames_of_an_atlas(tmp_path: Path) -> None:
    sheet = np.zeros((2, 4, 3), np.uint8)
    sheet[:, 2:] = (0, 0, 255)
    out = io.BytesIO()
    Image.fromarray(sheet).save(out, "PNG")
    found = load_files(tmp_path, cook_png=out.getvalue(), cook_json={"frameWidth": 2})
    sprite = {"id": 1, "type": "sprite", "image": "cook.png", "frame": 1, "x": 0, "y": 0, "width": 20, "height": 20}
    picture = raster_of(found).draw(as_scene([sprite]))
    assert (pixel(picture, 10, 10), pixel(picture, 21, 10)) == ("#0000ff", "#ffffff")
    middle = sprite | {"origin": (0.5, 0.5), "x": 0.5, "y": 0.5, "angle": 45, "alpha": 0.5}
    assert pixel(raster_of(found).draw(as_scene([middle])), 50, 25) in ("#7f7fff", "#8080ff")


def test_a_transparent_sprite_does_not_change_the_image_for_other_sprites(tmp_path: Path) -> None:
    found = load_files(tmp_path, cook_png=image())
    sprite = {"id": 1, "type": "sprite", "image": "cook.png", "x": 0, "y": 0}
    plain = raster_of(found).draw(as_scene([sprite]))
    faint = raster_of(found).draw(as_scene([sprite | {"alpha": 0.5}]))
    assert pixel(plain, 0, 0) != pixel(faint, 0, 0)
    assert pixel(raster_of(found).draw(as_scene([sprite])), 0, 0) == pixel(plain, 0, 0)


def test_a_missing_image_is_a_grey_box() -> None:
    sprite = {"id": 1, "type": "sprite", "image": "../../etc/passwd", "x": 0, "y": 0, "width": 10, "height": 10}
    assert pixel(raster_of().draw(as_scene([sprite])), 5, 5) == "#c0c0c0"
