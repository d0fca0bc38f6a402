"""Pictures on the wire (docs/wire.md, "A binary frame"): lossless key frames and XOR differences. Pure."""

from __future__ import annotations

import base64
import io
import json
import struct
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

_deflate: Any
try:
    from isal import isal_zlib

    # Level 2 of ISA-L packs Ms. Pac-Man's differences smaller than zlib's level 1, in a quarter of its time.
    _deflate, _LEVEL = isal_zlib, 2
except ImportError:  # no wheel for this machine: slower, the same pixels on arrival
    _deflate, _LEVEL = zlib, 1

Frame = npt.NDArray[np.uint8]
"""height x width x channels; channels is 3 (RGB) or 1 (grey)."""

LARGEST = 4096 * 4096
"""Pixels of a picture. A browser needs four bytes for each, and refuses more (web/game.js)."""

KEY, DIFFERENCE = 0, 1
HEADER = struct.Struct("!BIHHB")


class FrameError(ValueError):
    """A picture that cannot be shown, or bytes that are not a frame."""


def as_frame(picture: Any) -> Frame:
    """A private, contiguous copy of what `render()` returned. Raises FrameError if that is no picture."""
    if picture is None:
        raise FrameError("render() returned nothing; make the environment with render_mode='rgb_array'")
    array = np.asarray(picture)
    if array.ndim == 2:
        array = array[:, :, np.newaxis]
    if array.ndim != 3 or array.dtype != np.uint8:
        raise FrameError(f"render() must return height x width x 3 bytes, not {array.dtype} of {array.shape}")
    if array.shape[2] == 4:
        array = array[:, :, :3]
    height, width, channels = array.shape
    if channels not in (1, 3) or not (0 < height <= 0xFFFF and 0 < width <= 0xFFFF):
        raise FrameError(f"render() must return height x width x 3 bytes, not {array.shape}")
    if height * width > LARGEST:
        raise FrameError(f"render() returned {width} x {height} pixels; browsers are shown {LARGEST} at most")
    return np.array(array, dtype=np.uint8, order="C", copy=True)


class Encoder:
    """Packs frames for one connection; each difference is taken to the frame packed before it."""

    def __init__(self) -> None:
        self._last: Frame | None = None

    def encode(self, frame: Frame, frame_id: int) -> bytes:
        """The bytes of one frame. `frame` is kept for the next difference and must not change afterwards."""
        height, width, channels = frame.shape
        last = self._last
        if last is None or last.shape != frame.shape:
            kind, pixels = KEY, frame
        else:
            kind, pixels = DIFFERENCE, np.bitwise_xor(frame, last)
        self._last = frame
        packer = _deflate.compressobj(_LEVEL, zlib.DEFLATED, -15)
        header = HEADER.pack(kind, frame_id & 0xFFFFFFFF, width, height, channels)
        return b"".join((header, packer.compress(pixels), packer.flush()))


class Decoder:
    """Unpacks the frames of one connection; what a browser does, for tests and tools."""

    def __init__(self) -> None:
        self._last: Frame | None = None

    def decode(self, data: bytes) -> tuple[int, Frame]:
        """The frame's id and picture. Raises FrameError for bytes that are not a frame in this sequence."""
        if len(data) < HEADER.size:
            raise FrameError("too short")
        kind, frame_id, width, height, channels = HEADER.unpack_from(data)
        try:
            pixels = zlib.decompress(data[HEADER.size :], -15)
        except zlib.error as error:
            raise FrameError("not deflate") from error
        if len(pixels) != width * height * channels:
            raise FrameError("wrong length")
        frame = np.frombuffer(pixels, dtype=np.uint8).reshape(height, width, channels)
        if kind == DIFFERENCE:
            if self._last is None or self._last.shape != frame.shape:
                raise FrameError("a difference to a frame that was not sent")
            frame = np.bitwise_xor(frame, self._last)
        elif kind != KEY:
            raise FrameError("unknown kind")
        self._last = frame
        return frame_id, frame


def jpeg_message(frame: Frame, frame_id: int) -> str:
    """A frame as HIPPO's browsers expect it: JSON holding a base64 JPEG."""
    from PIL import Image  # noqa: PLC0415 - only for clients that offer no subprotocol

    picture = Image.fromarray(frame if frame.shape[2] == 3 else frame[:, :, 0])
    out = io.BytesIO()
    picture.save(out, "JPEG")
    return json.dumps({"frame": base64.b64encode(out.getvalue()).decode("ascii"), "frameId": frame_id})
