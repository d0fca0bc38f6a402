"""Frames, and their bytes on the wire (docs/wire.md, "A binary frame"). Pure."""

from __future__ import annotations

import base64
import io
import json
import math
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
except ImportError:  # there is no wheel for this machine: zlib is slower, and the client gets the same pixels
    _deflate, _LEVEL = zlib, 1

Frame = npt.NDArray[np.uint8]
"""height x width x channels; channels is 3 (RGB) or 1 (grey)."""

LARGEST = 4096 * 4096
"""The most pixels of a picture. The page, which needs four bytes for each, refuses more (web/game/frames.js)."""

KEY, DIFFERENCE, JPEG, ROWS = 0, 1, 2, 3
"""Kinds of frames: the whole picture, its XOR with the last exact frame, a JPEG, or some rows without loss."""
HEADER = struct.Struct("!BIHHB")
"""Kind, id, width, height, channels."""
FIRST_ROW = struct.Struct("!H")
"""The number of the first row, which follows the header of a ROWS frame."""
MAX_JPEG_SIDE = 65_500
"""In pixels; libjpeg's JPEG_MAX_DIMENSION."""

_EXPECTED = (
    "and must return height x width x 3 bytes (numpy.uint8): environments of Gymnasium do with render_mode='rgb_array'"
)
_FIRST_CHUNK = 131_072  # bytes of pixels that are packed before the size is compared with the limit


class FrameError(ValueError):
    """A picture cannot be shown, or bytes are no frame."""


def as_frame(picture: Any) -> Frame:
    """Copy the pixels that `render()` returned into a contiguous array. Raises FrameError if they are no picture."""
    if picture is None:
        why = "is a `return` missing? Gymnasium's environments need render_mode='rgb_array'"
        raise FrameError(f"render() returned nothing: {why}")
    if hasattr(picture, "getpalette"):  # a picture of Pillow, of any mode
        picture = picture.convert("RGB")
    try:
        array = np.asarray(picture)
    except Exception as error:  # the object's own code
        raise FrameError(f"render() returned {type(picture).__name__}, {_EXPECTED}") from error
    if array.ndim == 2:
        array = array[:, :, np.newaxis]
    if array.ndim != 3 or array.dtype != np.uint8:
        described = f"{array.dtype} of {array.shape}" if array.dtype.kind in "biuf" else type(picture).__name__
        raise FrameError(f"render() returned {described}, {_EXPECTED}")
    if array.shape[2] == 4:
        array = array[:, :, :3]
    height, width, channels = array.shape
    if channels not in (1, 3) or not (0 < height <= 0xFFFF and 0 < width <= 0xFFFF):
        raise FrameError(f"render() must return height x width x 3 bytes, not {array.shape}")
    if height * width > LARGEST:
        raise FrameError(f"render() returned {width} x {height} pixels; browsers are shown {LARGEST} at most")
    return array.copy()  # contiguous, however the environment has stored it


def header(kind: int, frame: Frame, frame_id: int) -> bytes:
    """Build the header of a binary frame. Ids begin again at 0 after 2**32 frames."""
    height, width, channels = frame.shape
    return HEADER.pack(kind, frame_id & 0xFFFFFFFF, width, height, channels)


def packed(rows: Frame, base: Frame | None = None, limit: float = math.inf) -> bytes | None:
    """Deflate the pixels of some rows, or their XOR with `base`. Return None if the result exceeds `limit` bytes."""
    packer = _deflate.compressobj(_LEVEL, zlib.DEFLATED, -15)
    # Each call takes time and adds bytes, so the chunks grow.
    count = len(rows) if limit == math.inf else max(1, _FIRST_CHUNK // rows[0].nbytes)
    parts: list[bytes] = []
    size = first = 0
    while first < len(rows):
        chunk = rows[first : first + count]
        parts.append(packer.compress(chunk if base is None else np.bitwise_xor(chunk, base[first : first + count])))
        size += len(parts[-1])
        if size > limit:
            return None
        first, count = first + count, 2 * count
    parts.append(packer.flush())
    return b"".join(parts) if size + len(parts[-1]) <= limit else None


def jpeg_frame(frame: Frame, frame_id: int) -> bytes:
    """Build a binary frame of the kind JPEG."""
    return header(JPEG, frame, frame_id) + jpeg(frame)


def jpeg(frame: Frame, quality: int = 80) -> bytes:
    """Encode the picture as a JPEG.

    Quality 80 takes 15 % more bytes and no more time than Pillow's default of 75, which HIPPO's servers send. WebP
    takes six times as long for about as many bytes.
    """
    from PIL import Image  # noqa: PLC0415 - many games never need it

    picture = Image.fromarray(frame if frame.shape[2] == 3 else frame[:, :, 0])
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=quality)
    return out.getvalue()


class Decoder:
    """Unpacks the frames of one connection, as a browser does. For tests and tools."""

    def __init__(self) -> None:
        self._exact: Frame | None = None  # the last picture without loss
        self._shown: Frame | None = None
        self._rows = 0  # how many rows have come of a picture that comes as ROWS

    def decode(self, data: bytes) -> tuple[int, Frame]:
        """Decode a binary frame. Return its id, and the picture that is shown now.

        Raises FrameError for bytes that are no frame, or that cannot follow the frames before.
        """
        if len(data) < HEADER.size:
            raise FrameError("too short")
        kind, frame_id, width, height, channels = HEADER.unpack_from(data)
        if not 0 < width * height <= LARGEST or channels not in (1, 3):
            raise FrameError("no such picture")
        if self._shown is not None and self._shown.shape != (height, width, channels):
            self._exact = self._shown = None
        rows_before, self._rows = self._rows, 0
        body, shape = data[HEADER.size :], (height, width, channels)
        if kind == JPEG:
            self._shown = _unpacked_jpeg(body, shape)
        elif kind == ROWS:
            self._shown = self._with_rows(body, shape, rows_before)
        elif kind == KEY:
            self._shown = self._exact = _inflated(body, shape)
        elif kind == DIFFERENCE:
            if self._exact is None:
                raise FrameError("a difference to a frame that was not sent")
            self._shown = self._exact = np.bitwise_xor(_inflated(body, shape), self._exact)
        else:
            raise FrameError("unknown kind")
        return frame_id, self._shown

    def _with_rows(self, body: bytes, shape: tuple[int, int, int], before: int) -> Frame:
        if self._shown is None or len(body) < FIRST_ROW.size:
            raise FrameError("rows of no picture")
        (first,) = FIRST_ROW.unpack_from(body)
        if first not in (0, before):
            raise FrameError("rows are missing")
        height = shape[0]
        rows = _inflated(body[FIRST_ROW.size :], shape, most=height - first)
        shown = self._shown.copy()
        self._rows = first + len(rows)
        shown[first : self._rows] = rows
        self._exact = shown if self._rows == height else None
        return shown


def _inflated(body: bytes, shape: tuple[int, int, int], *, most: int | None = None) -> Frame:
    """Unpack as many rows as `shape` has; with `most`, 1 to `most` rows. Raises FrameError for anything else."""
    height, width, channels = shape
    expected = (most if most is not None else height) * width * channels
    unpacker = zlib.decompressobj(-15)
    try:
        pixels = unpacker.decompress(body, expected + 1)
    except zlib.error as error:
        raise FrameError("not deflate") from error
    whole_rows = 0 < len(pixels) <= expected and len(pixels) % (width * channels) == 0
    if not unpacker.eof or unpacker.unused_data or not whole_rows or (most is None and len(pixels) != expected):
        raise FrameError("wrong length")
    return np.frombuffer(pixels, dtype=np.uint8).reshape(-1, width, channels)


def _unpacked_jpeg(body: bytes, shape: tuple[int, int, int]) -> Frame:
    from PIL import Image  # noqa: PLC0415 - as above

    height, width, channels = shape
    try:
        picture = Image.open(io.BytesIO(body), formats=["JPEG"])
        if picture.size != (width, height):
            raise FrameError("a JPEG of another size")
        return np.asarray(picture.convert("RGB" if channels == 3 else "L")).reshape(shape)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise FrameError("not a JPEG of this size") from error


def jpeg_message(frame: Frame, frame_id: int) -> str:
    """Build the message of a frame for HIPPO's page: JSON with the JPEG in base64, in Pillow's default quality."""
    return json.dumps({"frame": base64.b64encode(jpeg(frame, quality=75)).decode("ascii"), "frameId": frame_id})
