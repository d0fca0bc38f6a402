"""Finds and checks the images that a project's sprites show, and packs them for browsers (docs/objects.md, "Images").

The images are the PNG, JPEG and WebP files in a folder and below it. A JSON file of the same name beside an image is
its atlas. The name of an image is its path in the folder, without its extension. SVG files are refused: they are
documents that may name other files and hold scripts.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeGuard

from hippodrome.protocol.file_names import composed

MAX_ASSETS = 500
MAX_BYTES = 4 * 2**20
"""The most bytes of one file: an image or an atlas."""
MAX_BYTES_IN_ALL = 20 * 2**20
"""The most bytes of all images, packed with their atlases."""
MAX_SIDE = 4096
"""The longest side of an image, in pixels: some phones draw no larger images."""
MAX_PIXELS_IN_ALL = 64 * 2**20
"""The most pixels of all images. A browser needs four bytes for each pixel."""
MAX_FRAMES = 2_000
"""The most frames of one atlas."""

IMAGE = re.compile(r"\.(?:png|jpe?g|webp)$", re.IGNORECASE)
"""The end of the name of an image file."""
_REFUSED = re.compile(r"\.(?:svgz?|gif|bmp|tiff?|avif|ico)$", re.IGNORECASE)
_TYPES = {"PNG": "image/png", "JPEG": "image/jpeg", "WEBP": "image/webp"}
_HEAD = struct.Struct("!I")

Box = tuple[int, int, int, int]
"""Left, top, width and height in an image, in pixels."""


class AssetError(ValueError):
    """A file cannot be used. The message is the end of a sentence that begins with the file's name."""


@dataclass(frozen=True, slots=True)
class AtlasAnimation:
    """Frames of an atlas that are shown one after the other."""

    frames: tuple[str, ...]
    rate: float
    """Frames per second."""


@dataclass(frozen=True, slots=True)
class Asset:
    """An image, with the frames and animations of its atlas."""

    name: str
    image: bytes = field(repr=False)
    size: tuple[int, int]
    """Width and height in pixels."""
    packed: bytes = field(repr=False)
    """The bytes for browsers: the length of a JSON object (4 bytes), that object, and the image."""
    hash: str
    """The beginning of the SHA-256 of `packed`, as 32 hexadecimal digits."""
    frames: Mapping[str, Box] = field(default_factory=dict)
    animations: Mapping[str, AtlasAnimation] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Assets:
    """The images of a folder by name, and the problems of its files, in sentences for the researcher."""

    by_name: Mapping[str, Asset] = field(default_factory=dict)
    problems: tuple[str, ...] = ()

    def table(self) -> list[dict[str, Any]]:
        """Return the images' table for a client, which asks for the images whose hashes it does not have."""
        return [{"name": asset.name, "bytes": len(asset.packed), "hash": asset.hash} for asset in self.by_name.values()]


def load(project: Path, folder: str) -> Assets:
    """Read the images in a folder of a project. Files that cannot be used raise nothing: `problems` names them."""
    assets_folder = project / folder
    if not assets_folder.is_dir():
        return Assets()
    assets: dict[str, Asset] = {}
    problems: list[str] = []
    total = pixels = 0
    try:
        paths = list(_files(assets_folder))
    except OSError as error:
        return Assets({}, (f"{folder} cannot be read ({type(error).__name__})",))
    for path in paths:
        name = path.relative_to(assets_folder).with_suffix("").as_posix()
        shown = path.relative_to(project).as_posix()
        try:
            if _REFUSED.search(path.name):
                raise AssetError("is no PNG, JPEG or WebP image; sprites show only these")
            if not IMAGE.search(path.name):
                continue
            if name in assets:
                raise AssetError("has the name of another image, apart from its extension; rename one of them")
            asset = read(path, name)
            total += len(asset.packed)
            pixels += asset.size[0] * asset.size[1]
            if len(assets) == MAX_ASSETS or total > MAX_BYTES_IN_ALL or pixels > MAX_PIXELS_IN_ALL:
                problems.append(
                    f"{folder}: more than {MAX_ASSETS} images, {MAX_BYTES_IN_ALL >> 20} MB or "
                    f"{MAX_PIXELS_IN_ALL >> 20} megapixels; {shown} and all after it are not shown"
                )
                break
            assets[name] = asset
            if composed(name) not in assets:
                assets[composed(name)] = replace(asset, name=composed(name))
        except AssetError as error:
            problems.append(f"{shown} {error}")
    return Assets(assets, tuple(problems))


def _files(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and below it, in the order of their names, without links and hidden files."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.is_symlink():
            continue
        if path.is_dir():
            yield from _files(path)
        elif path.is_file():
            yield path


def read(path: Path, name: str) -> Asset:
    """Read and check an image and the atlas beside it. Raises AssetError."""
    image = _bytes(path)
    kind, size = _kind(image)
    frames: dict[str, Box] = {}
    animations: dict[str, AtlasAnimation] = {}
    atlas = path.with_suffix(".json")
    if atlas.is_file() and not atlas.is_symlink():
        try:
            frames, animations = read_atlas(json.loads(_bytes(atlas)), size)
        except (ValueError, RecursionError) as error:
            problem = str(error) if isinstance(error, AssetError) else "is no JSON"
            raise AssetError(f"cannot be shown: {atlas.name} beside it {problem}") from None
    about: dict[str, Any] = {"type": kind}
    if frames:
        about["frames"] = frames
    if animations:
        about["animations"] = {key: [list(animation.frames), animation.rate] for key, animation in animations.items()}
    head = json.dumps(about, separators=(",", ":"), ensure_ascii=False).encode()
    packed = _HEAD.pack(len(head)) + head + image
    return Asset(name, image, size, packed, hashlib.sha256(packed).hexdigest()[:32], frames, animations)


def _bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_BYTES:
            raise AssetError(f"has {path.stat().st_size >> 20} MB; a file has at most {MAX_BYTES >> 20} MB")
        return path.read_bytes()
    except OSError as error:
        raise AssetError(f"cannot be read ({type(error).__name__})") from None


def _kind(image: bytes) -> tuple[str, tuple[int, int]]:
    """Return the media type and the size of an image. Raises AssetError."""
    import io  # noqa: PLC0415 - as below
    import warnings  # noqa: PLC0415

    from PIL import Image  # noqa: PLC0415 - only games with a scene need it

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow warns of very large images, which are refused below
            with Image.open(io.BytesIO(image), formats=list(_TYPES)) as picture:
                kind, size = _TYPES[str(picture.format)], picture.size
                if max(size) <= MAX_SIDE:
                    picture.load()  # all of it, since the beginning of a file that was cut off is good
    except Exception:  # noqa: BLE001 - Pillow raises many kinds for a broken file
        raise AssetError("is no PNG, JPEG or WebP image, or is broken") from None
    if max(size) > MAX_SIDE:
        raise AssetError(f"has {size[0]} x {size[1]} pixels; at most {MAX_SIDE} x {MAX_SIDE} are shown")
    return kind, size


# ---- atlases


def read_atlas(value: Any, size: tuple[int, int]) -> tuple[dict[str, Box], dict[str, AtlasAnimation]]:
    """Read the frames and animations of an atlas for an image of this size.

    `value` has TexturePacker's or Phaser's form (https://docs.phaser.io/phaser/concepts/textures#atlas), or
    `frameWidth` and `frameHeight` for frames of one size. Raises AssetError.
    """
    if not isinstance(value, dict):
        raise AssetError("is no atlas, which is a JSON object with `frames` or with `frameWidth`")
    frames = _grid(value, size) if "frameWidth" in value else dict(_listed(value, size))
    if len(frames) > MAX_FRAMES:
        raise AssetError(f"has {len(frames)} frames; at most {MAX_FRAMES}")
    animations = value.get("animations", {})
    if not isinstance(animations, dict):
        raise AssetError("has animations that are no map")
    return frames, {str(key): _animation(str(key), animation, frames) for key, animation in animations.items()}


def _grid(value: Mapping[str, Any], size: tuple[int, int]) -> dict[str, Box]:
    """Return an atlas's frames of one size, named by their numbers from 0, row by row."""
    width, height = value.get("frameWidth"), value.get("frameHeight", value.get("frameWidth"))
    if not _is_whole(width, 1) or not _is_whole(height, 1):
        raise AssetError("has a frameWidth or frameHeight that is no whole number of pixels")
    columns, rows = size[0] // width, size[1] // height
    if columns * rows > MAX_FRAMES:
        raise AssetError(f"has {columns * rows} frames; at most {MAX_FRAMES}")
    return {
        str(row * columns + column): (column * width, row * height, width, height)
        for row in range(rows)
        for column in range(columns)
    }


def _listed(value: Mapping[str, Any], size: tuple[int, int]) -> Iterator[tuple[str, Box]]:
    """Yield the name and the box of each frame that the atlas lists."""
    frames = value.get("frames")
    textures = value.get("textures")
    if frames is None and isinstance(textures, list) and len(textures) == 1 and isinstance(textures[0], dict):
        frames = textures[0].get("frames")  # Phaser's multiatlas with one image
    pairs: list[tuple[Any, Any]]
    if isinstance(frames, dict):
        pairs = list(frames.items())
    elif isinstance(frames, list):
        pairs = [(frame.get("filename") if isinstance(frame, dict) else None, frame) for frame in frames]
    else:
        raise AssetError("has no frames")
    for name, frame_entry in pairs[: MAX_FRAMES + 1]:
        box = frame_entry.get("frame") if isinstance(frame_entry, dict) else None
        if not isinstance(name, str) or not isinstance(box, dict):
            raise AssetError("has a frame without a name, or without a box (x, y, w, h) as its `frame`")
        if frame_entry.get("rotated"):
            raise AssetError(f"has the frame {name[:40]!r} turned; pack it without rotation")
        left, top, width, height = (box[key] if _is_whole(box.get(key), 0) else -1 for key in ("x", "y", "w", "h"))
        if not (_inside(left, width, size[0]) and _inside(top, height, size[1])):
            raise AssetError(f"has the frame {name[:40]!r} outside of the image")
        yield name, (left, top, width, height)


def _inside(start: int, length: int, whole: int) -> bool:
    return start >= 0 and length > 0 and start + length <= whole


def _is_whole(value: Any, least: int) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= MAX_SIDE


def _animation(name: str, value: Any, frames: Mapping[str, Box]) -> AtlasAnimation:
    if isinstance(value, list):
        value = {"frames": value}
    listed = value.get("frames") if isinstance(value, dict) else None
    if not isinstance(listed, list) or not 0 < len(listed) <= MAX_FRAMES:
        raise AssetError(f"has the animation {name[:40]!r} without frames")
    missing = next((str(listing) for listing in listed if str(listing) not in frames), None)
    if missing is not None:
        raise AssetError(f"has the animation {name[:40]!r} with a frame {missing[:40]!r} that is not there")
    rate = value.get("frameRate", 8)
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not math.isfinite(rate) or not 0 < rate <= 240:
        raise AssetError(f"has the animation {name[:40]!r} with a frameRate that is no number up to 240")
    return AtlasAnimation(tuple(str(listing) for listing in listed), rate)
