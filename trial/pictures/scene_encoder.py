"""Packs the scenes of a connection (docs/wire.md, "A scene"): only what changed. Pure."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from itertools import compress
from operator import is_not, ne
from typing import Any

from trial.pictures.scene import Scene
from trial.pictures.scene_object import CheckedObject

SCENE, PACKED_SCENE, ASSET = 4, 5, 6
"""Kinds of binary messages; those of frames are in `trial/pictures/frames.py`."""
HEADER = struct.Struct("!BI")
"""Kind, id."""
ASSET_HEADER = struct.Struct("!BHI")
"""Kind, number of the asset in the table, offset of the bytes that follow."""

_PACK_FROM = 1_200  # bytes; what fits into one packet gains nothing
_JSON = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


class SceneEncoder:
    """Packs scenes for one connection: the first whole, each other one as what changed since the one sent before.

    A WebSocket loses nothing and keeps the order, so what was sent is what the client has.
    """

    def __init__(self) -> None:
        self._sent: Scene | None = None

    def forget(self) -> None:
        """The next scene is sent whole: the client was shown something else."""
        self._sent = None

    def encode(self, scene: Scene, scene_id: int) -> bytes:
        """The bytes of one scene. `scene` is kept for the next one."""
        kind, body = _LAST.packed(self._sent, scene)
        self._sent = scene
        return HEADER.pack(kind, scene_id & 0xFFFFFFFF) + body


class _Last:
    """What was packed last. Those who play together are mostly shown the same scene after the same one."""

    def __init__(self) -> None:
        self._kept: tuple[Scene | None, Scene, tuple[int, bytes]] | None = None  # replaced whole: threads may pack

    def packed(self, before: Scene | None, scene: Scene) -> tuple[int, bytes]:
        """The kind of the message and its bytes behind the id."""
        kept = self._kept
        if kept is not None and kept[0] is before and kept[1] is scene:
            return kept[2]
        packed = _pack(changes(before, scene))
        self._kept = before, scene, packed
        return packed


_LAST = _Last()


def _pack(said: Mapping[str, Any]) -> tuple[int, bytes]:
    body = _JSON.encode(said).encode("utf-8", "replace")
    if len(body) <= _PACK_FROM:
        return SCENE, body
    packer = zlib.compressobj(1, zlib.DEFLATED, -15)
    return PACKED_SCENE, packer.compress(body) + packer.flush()


def changes(before: Scene | None, scene: Scene) -> dict[str, Any]:
    """What a client that shows `before` has to be told; with `new`, to forget all that it shows."""
    if before is None:
        return {"new": True, "set": dict(scene.objects), "hud": scene.hud}
    said: dict[str, Any] = {}
    known, objects = before.objects, scene.objects
    changed: dict[str, Any] = {}
    in_place = list(known) == list(objects)
    # Those that may have changed. Few have, and to look at the others one by one costs more than all else here.
    others = compress(objects.items(), map(is_not, known.values(), objects.values())) if in_place else objects.items()
    for name, each in others:
        earlier = known.get(name)
        if earlier is each:
            continue
        if earlier is None or earlier["type"] != each["type"]:
            changed[name] = each
        else:
            changed[name] = _fields(earlier, each)
    if changed:
        said["set"] = changed
    if not in_place:
        gone = [name for name in known if name not in objects]
        if gone:
            said["gone"] = gone
        if not _same_order(known, objects):
            said["order"] = list(objects)
    if scene.hud != before.hud:
        said["hud"] = scene.hud
    return said


def _fields(before: CheckedObject, now: CheckedObject) -> dict[str, Any]:
    """The fields that changed; None for those that have their default again."""
    if list(before) == list(now):  # the usual case
        return dict(compress(now.items(), map(ne, before.values(), now.values())))
    changed = {key: value for key, value in now.items() if key not in before or before[key] != value}
    return changed | {key: None for key in before if key not in now}


def _same_order(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether the objects stand in their order if those that are new are put behind the others."""
    stayed = [name for name in before if name in now]
    return all(one == other for one, other in zip(stayed, now, strict=False))


class SceneDecoder:
    """What a browser does with them, for tests and tools."""

    def __init__(self) -> None:
        self.objects: dict[str, dict[str, Any]] = {}
        """By id, in the order in which they are drawn."""
        self.hud = ""

    def decode(self, data: bytes) -> int:
        """Take a message; `objects` and `hud` are those of the scene then. Returns its id. Raises ValueError."""
        kind, scene_id = HEADER.unpack_from(data)
        if kind not in (SCENE, PACKED_SCENE):
            raise ValueError("no scene")
        body = data[HEADER.size :]
        said = json.loads(body if kind == SCENE else zlib.decompress(body, -15))
        if said.get("new"):
            self.objects = {}
        for name in said.get("gone", ()):
            del self.objects[name]
        for name, fields in said.get("set", {}).items():
            if "type" in fields:
                self.objects[name] = dict(fields) if name not in self.objects else self._replaced(name, fields)
            else:
                merged = self.objects[name] | fields
                self.objects[name] = {key: value for key, value in merged.items() if value is not None}
        if "order" in said:
            self.objects = {name: self.objects[name] for name in said["order"]}
        self.hud = said.get("hud", self.hud)
        return int(scene_id)

    def _replaced(self, name: str, fields: dict[str, Any]) -> dict[str, Any]:
        self.objects[name].clear()
        self.objects[name].update(fields)
        return self.objects[name]
