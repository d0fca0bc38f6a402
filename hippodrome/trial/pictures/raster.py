"""Draws scenes as frames, for clients that do not draw objects, such as HIPPO's front end.

The frames look as `hippodrome/web/game/painter.js` draws the scenes, apart from smooth edges, fonts and tweens.
"""

from __future__ import annotations

import threading
from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFont

from hippodrome.protocol.trial_sections import SceneSection
from hippodrome.trial.pictures.assets import Asset, Assets
from hippodrome.trial.pictures.frames import Frame
from hippodrome.trial.pictures.scene import Scene
from hippodrome.trial.pictures.scene_object import CheckedObject

_MISSING = "#8080807f"  # the color of the box that is drawn if an image is missing

Rgba = tuple[int, int, int, int]


class Raster:
    """Draws the scenes of a project. Its methods may be called by any thread."""

    def __init__(self, section: SceneSection, assets: Assets) -> None:
        self._size = section.width, section.height
        self._background = section.background
        self._scale = self._size if section.coordinates == "relative" else (1, 1)
        self._filter = Image.Resampling.NEAREST if section.pixel_art else Image.Resampling.BILINEAR
        self._assets = assets
        self._lock = threading.Lock()
        self._sprite = lru_cache(maxsize=256)(self._new_sprite)

    def draw(self, scene: Scene) -> Frame:
        """Draw the scene. Return it as a frame of RGB values."""
        with self._lock:
            canvas = Image.new("RGB", self._size, self._background)
            for scene_object in sorted(scene.objects.values(), key=lambda drawn: float(drawn.get("depth", 0))):
                self._object(canvas, scene_object)
            return np.array(canvas, dtype=np.uint8)

    def _object(self, canvas: Image.Image, checked_object: CheckedObject) -> None:
        kind, brush = checked_object["type"], ImageDraw.Draw(canvas, "RGBA")
        if kind == "line":
            self._line(brush, checked_object)
        elif kind == "polygon":
            points = self._points(checked_object)
            brush.polygon(
                points,
                fill=_fill(checked_object),
                outline=_outline(checked_object),
                width=_outline_width(checked_object),
            )
        elif kind == "circle":
            (x, y), radius = self._place(checked_object), _bounded(checked_object["radius"])
            box = (x - radius, y - radius, x + radius, y + radius)
            brush.ellipse(
                box, fill=_fill(checked_object), outline=_outline(checked_object), width=_outline_width(checked_object)
            )
        elif kind == "rectangle":
            self._rectangle(brush, checked_object)
        elif kind == "text":
            self._text(canvas, checked_object)
        else:
            self._paste(canvas, checked_object)

    def _place(self, checked_object: CheckedObject) -> tuple[float, float]:
        return _bounded(checked_object["x"] * self._scale[0]), _bounded(checked_object["y"] * self._scale[1])

    def _points(self, checked_object: CheckedObject) -> list[tuple[float, float]]:
        across, down = self._scale
        return [(_bounded(x * across), _bounded(y * down)) for x, y in checked_object["points"]]

    def _line(self, brush: ImageDraw.ImageDraw, checked_object: CheckedObject) -> None:
        points, ink = self._points(checked_object), _fill(checked_object)
        for key, edge in (("fill_above", 0), ("fill_below", self._size[1])):
            if checked_object.get(key):
                brush.polygon([*points, (points[-1][0], edge), (points[0][0], edge)], fill=ink)
        brush.line(points, fill=ink, width=max(1, round(_bounded(checked_object.get("width", 1)))), joint="curve")

    def _rectangle(self, brush: ImageDraw.ImageDraw, checked_object: CheckedObject) -> None:
        (x, y), width, height = (
            self._place(checked_object),
            _bounded(checked_object["width"]),
            _bounded(checked_object["height"]),
        )
        (share_x, share_y), turn = checked_object.get("origin", (0, 0)), np.radians(checked_object.get("angle", 0))
        left, top = -share_x * width, -share_y * height
        cos, sin = float(np.cos(turn)), float(np.sin(turn))
        corners = [(left, top), (left + width, top), (left + width, top + height), (left, top + height)]
        points = [(x + across * cos - down * sin, y + across * sin + down * cos) for across, down in corners]
        brush.polygon(
            points, fill=_fill(checked_object), outline=_outline(checked_object), width=_outline_width(checked_object)
        )

    def _text(self, canvas: Image.Image, checked_object: CheckedObject) -> None:
        size = checked_object.get("size", 16)
        most = int(4 * max(self._size) / size) + 1  # letters and lines outside the picture would only need memory
        text = "\n".join(line[:most] for line in checked_object["text"].split("\n")[:most])
        font, ink = ImageFont.load_default(size), _fill(checked_object)
        _, _, right, bottom = ImageDraw.Draw(canvas).multiline_textbbox((0, 0), text, font)
        width, height = min(2_000, round(right) + 1), min(2_000, round(bottom) + 1)
        if width < 1 or height < 1:
            return
        layer = Image.new("RGBA", (width, height))
        share = checked_object.get("origin", (0, 0))[0]
        align = "left" if share < 0.25 else "center" if share < 0.75 else "right"
        ImageDraw.Draw(layer).multiline_text((0, 0), text, ink, font, align=align)
        self._lay(canvas, layer, checked_object)

    def _paste(self, canvas: Image.Image, checked_object: CheckedObject) -> None:
        asset = self._assets.by_name.get(checked_object["image"])
        frame = checked_object.get("frame")
        if asset is not None and checked_object.get("animation") in asset.animations:
            frame = asset.animations[checked_object["animation"]].frames[0]
        width, height = _length(checked_object.get("width")), _length(checked_object.get("height"))
        self._lay(
            canvas,
            self._sprite(checked_object["image"], frame, width, height, checked_object.get("alpha", 1)),
            checked_object,
        )

    def _new_sprite(self, name: str, frame: str | None, width: int, height: int, alpha: float) -> Image.Image:
        """Draw a sprite, not yet turned; a grey box if there is no such image or frame."""
        asset = self._assets.by_name.get(name)
        picture = None if asset is None else _cut(asset, frame)
        if picture is None:
            return Image.new("RGBA", (width or 32, height or 32), _MISSING)
        if width or height:
            width = width or round(height * picture.width / picture.height) or 1
            height = height or round(width * picture.height / picture.width) or 1
            picture = picture.resize((width, height), self._filter)
        if alpha < 1:
            picture = picture.copy()  # it may be the image itself, which other sprites show too
            picture.putalpha(picture.getchannel("A").point(lambda value: round(value * alpha)))
        return picture

    def _lay(self, canvas: Image.Image, layer: Image.Image, checked_object: CheckedObject) -> None:
        """Draw a picture on the canvas, turned about its origin."""
        (x, y), (share_x, share_y) = self._place(checked_object), checked_object.get("origin", (0, 0))
        across, down = (0.5 - share_x) * layer.width, (0.5 - share_y) * layer.height  # from the origin to the middle
        angle = checked_object.get("angle", 0)
        if angle:
            turn = np.radians(angle)
            cos, sin = float(np.cos(turn)), float(np.sin(turn))
            across, down = across * cos - down * sin, across * sin + down * cos
            layer = layer.rotate(-angle, Image.Resampling.BILINEAR, expand=True)
        place = round(x + across - layer.width / 2), round(y + down - layer.height / 2)
        canvas.paste(layer, place, layer)


def _cut(asset: Asset, frame: str | None) -> Image.Image | None:
    """Cut a frame out of an image. Return the whole image without `frame`, None if the image has no such frame."""
    if frame is not None and frame not in asset.frames:
        return None
    whole = _opened(asset.image)
    if frame is None:
        return whole
    left, top, width, height = asset.frames[frame]
    return whole.crop((left, top, left + width, top + height))


@lru_cache(maxsize=4)
def _opened(image: bytes) -> Image.Image:
    import io  # noqa: PLC0415

    return Image.open(io.BytesIO(image)).convert("RGBA")


def _bounded(number: float) -> float:
    """Limit the number to ±20,000: Pillow takes time and memory for shapes far outside of the picture."""
    return max(-20_000.0, min(20_000.0, number))


def _length(value: Any) -> int:
    """Limit a length in pixels to 1 to 4,096; 0 for None."""
    return 0 if value is None else max(1, min(4_096, round(value)))


def _fill(checked_object: CheckedObject) -> Rgba:
    return _ink(checked_object.get("color", "#000000"), checked_object)


def _outline(checked_object: CheckedObject) -> Rgba | None:
    return _ink(checked_object["outline"], checked_object) if "outline" in checked_object else None


def _outline_width(checked_object: CheckedObject) -> int:
    return max(1, round(min(1_000, checked_object.get("outline_width", 1)))) if "outline" in checked_object else 1


def _ink(color: str, checked_object: CheckedObject) -> Rgba:
    """Return the color as RGBA, with the object's `alpha`."""
    red, green, blue, *rest = ImageColor.getcolor(color, "RGBA")  # type: ignore[misc]
    return red, green, blue, round((rest[0] if rest else 255) * checked_object.get("alpha", 1))
