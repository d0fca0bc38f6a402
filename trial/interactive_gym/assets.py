"""Collects the images and atlases of an experiment for the project's folder `assets/`."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from trial.interactive_gym.object_contexts import fields_of
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.sources import Locate

IMAGES = (".png", ".jpg", ".jpeg", ".webp")


def asset_files(config: RemoteConfig, locate: Locate, remark: Callable[[str], None]) -> dict[str, bytes]:
    """Return the files of `assets/` by their paths. Call `remark` with a sentence about each image that is left out."""
    files: dict[str, bytes] = {}
    if "assets_dir" in config.given:
        folder = locate(config.assets_dir)
        if folder is None:
            remark(f"assets_dir: there is no folder {config.assets_dir}")
        elif folder.is_dir():
            for path in sorted(folder.rglob("*")):
                if path.suffix.lower() in (*IMAGES, ".json") and path.is_file():
                    files[path.relative_to(folder).as_posix()] = path.read_bytes()
    for spec in [*config.assets_to_preload, *(config.preload_specs or ())]:
        _add(fields_of(spec), locate, remark, files)
    _animate(config, files, remark)
    return files


def _add(
    spec: Mapping[str, Any],
    locate: Locate,
    remark: Callable[[str], None],
    files: dict[str, bytes],
) -> None:
    name, image = str(spec.get("name", "")), spec.get("img_path")
    stem = name.rpartition(".")[0] if Path(name).suffix.lower() in IMAGES else name
    path = locate(str(image)) if image else None
    if not stem or path is None or not path.is_file():
        remark(f"the image {name!r} is not found at {image}; sprites that show it are grey boxes")
        return
    if path.suffix.lower() not in IMAGES:
        remark(f"the image {name!r} is no PNG, JPEG or WebP file; sprites that show it are grey boxes")
        return
    files[f"{stem}{path.suffix.lower()}"] = path.read_bytes()
    if spec.get("atlas_path") is None:
        return
    atlas = locate(str(spec["atlas_path"]))
    if atlas is None or not atlas.is_file():
        remark(f"the atlas of {name!r} is not found at {spec['atlas_path']}")
        return
    files[f"{stem}.json"] = _single(atlas.read_bytes(), name, remark)


def _single(atlas: bytes, name: str, remark: Callable[[str], None]) -> bytes:
    """Return an atlas of one image. Of Phaser's multiatlas (`textures`) only the first image is used."""
    try:
        textures = json.loads(atlas).get("textures")
    except (ValueError, AttributeError):
        return atlas
    if not textures:
        return atlas
    if len(textures) > 1:
        remark(f"the atlas of {name!r} has {len(textures)} images; only the first is drawn: pack them into one")
    return json.dumps({"frames": textures[0].get("frames", [])}).encode()


def _animate(config: RemoteConfig, files: dict[str, bytes], remark: Callable[[str], None]) -> None:
    """Write the animations into the atlases of their sprite sheets."""
    for each in config.animation_configs:
        spec = fields_of(each)
        key, sheet = str(spec.get("key")), f"{spec.get('sprite_sheet_key')}.json"
        if sheet not in files:
            remark(f"the animation {key!r} is left out: its sprite sheet {spec.get('sprite_sheet_key')!r} has no atlas")
            continue
        atlas = json.loads(files[sheet])
        animation: dict[str, Any] = {"frames": list(spec.get("frames", ()))}
        if spec.get("frameRate"):
            animation["frameRate"] = spec["frameRate"]
        atlas.setdefault("animations", {})[key] = animation
        files[sheet] = json.dumps(atlas).encode()
