"""Packs the scenes of a connection: of each scene only what changed (docs/wire.md, "A scene"). Pure."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from itertools import compress
from operator import is_not, ne
from typing import Any

from hippodrome.trial.pictures.scene import Scene
from hippodrome.trial.pictures.scene_object import CheckedObject

SCENE, PACKED_SCENE, ASSET = 4, 5, 6
"""Kinds of binary messages; the kinds of frames are in `hippodrome/trial/pictures/frames.py`."""
HEADER = struct.Struct("!BI")
"""Kind, id."""
ASSET_HEADER = struct.Struct("!BHI")
"""Kind, number of the asset in the table of assets, offset of the bytes that follow."""

_PACK_FROM = 1_200  # bytes; a shorter message fits into one packet anyway
_JSON = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


class SceneEncoder:
    """Encodes the scenes of one connection: the first scene whole, then the changes from each scene to the next.

    A WebSocket loses no message and keeps their order, so the client has the scene that was sent last. With `deflate`
    long messages are packed.
    """

    def __init__(self, *, deflate: bool = True) -> None:
        self._deflate = deflate
        self._sent: Scene | None = None

    def forget(self) -> None:
        """Let the next scene be encoded whole, since the client was shown something else."""
        self._sent = None

    def encode(self, scene: Scene, scene_id: int) -> bytes:
        """Encode one scene, and return its bytes. `scene` is kept, to compare it with the next one."""
        kind, body = _CACHE.packed(self._sent, scene, deflate=self._deflate)
        self._sent = scene
        return HEADER.pack(kind, scene_id & 0xFFFFFFFF) + body


class _Cache:
    """Keeps the changes that were packed last, since players of one game mostly see the same two scenes in a row."""

    def __init__(self) -> None:
        # Never changed: threads may read it.
        self._last: tuple[Scene | None, Scene, bool, tuple[int, bytes]] | None = None

    def packed(self, before: Scene | None, scene: Scene, *, deflate: bool) -> tuple[int, bytes]:
        """Return the kind of the message, and its bytes after the header."""
        last = self._last
        if last is not None and last[0] is before and last[1] is scene and last[2] is deflate:
            return last[3]
        packed = _pack(changes(before, scene), deflate=deflate)
        self._last = before, scene, deflate, packed
        return packed


_CACHE = _Cache()


def _pack(message: Mapping[str, Any], *, deflate: bool) -> tuple[int, bytes]:
    body = _JSON.encode(message).encode("utf-8", "replace")
    if not deflate or len(body) <= _PACK_FROM:
        return SCENE, body
    packer = zlib.compressobj(1, zlib.DEFLATED, -15)
    return PACKED_SCENE, packer.compress(body) + packer.flush()


def changes(before: Scene | None, scene: Scene) -> dict[str, Any]:
    """Build the message for a client that shows the scene `before`.

    With `new` in it, the client first forgets all objects.
    """
    if before is None:
        return {"new": True, "set": dict(scene.objects), "hud": scene.hud}
    message: dict[str, Any] = {}
    known, objects = before.objects, scene.objects
    changed: dict[str, Any] = {}
    in_place = list(known) == list(objects)
    # `compress` finds the few changed objects. A loop over all would take longer than the rest of this function.
    maybe = compress(objects.items(), map(is_not, known.values(), objects.values())) if in_place else objects.items()
    for name, scene_object in maybe:
        earlier = known.get(name)
        if earlier is scene_object:
            continue
        if earlier is None or earlier["type"] != scene_object["type"]:
            changed[name] = scene_object
        else:
            changed[name] = _fields(earlier, scene_object)
    if changed:
        message["set"] = changed
    if not in_place:
        removed = [name for name in known if name not in objects]
        if removed:
            message["gone"] = removed
        if not _same_order(known, objects):
            message["order"] = list(objects)
    if scene.hud != before.hud:
        message["hud"] = scene.hud
    return message


def _fields(before: CheckedObject, now: CheckedObject) -> dict[str, Any]:
    """Return the fields that have changed, with None for a field that has its default again."""
    if list(before) == list(now):  # the usual case
        return dict(compress(now.items(), map(ne, before.values(), now.values())))
    changed = {key: value for key, value in now.items() if key not in before or before[key] != value}
    return changed | {key: None for key in before if key not in now}


def _same_order(before: Mapping[str, Any], now: Mapping[str, Any]) -> bool:
    """Whether the client gets the objects' order right by putting the new ones behind the others."""
    stayed = [name for name in before if name in now]
    return all(one == other for one, other in zip(stayed, now, strict=False))


class SceneDecoder:
    """Unpacks the scenes of one connection, as a browser does. For tests and tools."""

    def __init__(self) -> None:
        self.objects: dict[str, dict[str, Any]] = {}
        """The objects by id, in the order in which they are drawn."""
        self.hud = ""

    def decode(self, data: bytes) -> int:
        """Read a message into `objects` and `hud`. Return the scene's id. Raises ValueError if it is no scene."""
        kind, scene_id = HEADER.unpack_from(data)
        if kind not in (SCENE, PACKED_SCENE):
            raise ValueError("no scene")
        body = data[HEADER.size :]
        message = json.loads(body if kind == SCENE else zlib.decompress(body, -15))
        if message.get("new"):
            self.objects = {}
        for name in message.get("gone", ()):
            del self.objects[name]
        for name, fields in message.get("set", {}).items():
            if "type" in fields:
                self.objects[name] = dict(fields) if name not in self.objects else self._replaced(name, fields)
            else:
                merged = self.objects[name] | fields
                self.objects[name] = {key: value for key, value in merged.items() if value is not None}
        if "order" in message:
            self.objects = {name: self.objects[name] for name in message["order"]}
        self.hud = message.get("hud", self.hud)
        return int(scene_id)

    def _replaced(self, name: str, fields: dict[str, Any]) -> dict[str, Any]:
        self.objects[name].clear()
        self.objects[name].update(fields)
        return self.objects[name]
