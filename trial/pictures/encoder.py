"""Chooses the coding of each frame of a connection (docs/wire.md, "A binary frame"). Pure."""

from __future__ import annotations

import numpy as np

from trial.pictures import frames
from trial.pictures.frames import DIFFERENCE, JPEG, KEY, ROWS, Frame

_EVERY = 16  # frames after which a coding that did not pay is tried again
_AGED = 8  # after lossless frames of this many JPEG sizes, encode a JPEG again to learn its size
_GREW = 1.25  # if a JPEG is this many times larger than the one before, try the lossless codings again
_PATIENCE = 4  # send a key frame once small differences would have saved this many times the raw picture


class Encoder:
    """Packs frames for one connection.

    Without `lossy` every frame is exact: a key frame, or a difference to the frame before it.

    With `lossy` no frame costs more than a JPEG of it. The difference and the key frame are packed only as long as they
    are smaller than the last JPEG was; otherwise a JPEG is sent. Packing (isal) is quick if it gives few bytes:
    whenever it gave fewer bytes than the JPEG, it was also no slower (`python -m bench trial` measures three kinds of
    picture). So the number of bytes decides, and the same frames give the same bytes on every machine. A coding that
    did not pay is tried again sixteen frames later.

    A difference refers to the last exact picture, which the client keeps; never to a JPEG, since decoders differ. A
    picture that does not change any more becomes exact by rows (`sharpen`).
    """

    def __init__(self, *, lossy: bool = False) -> None:
        self.lossy = lossy
        self._jpeg = b""
        self._begin()

    def forget(self) -> None:
        """The next frame is sent whole: the client was shown something else."""
        if self._shown is not None:
            self._begin()

    def _begin(self) -> None:
        self._shown: Frame | None = None  # the picture sent last, in any coding
        self._exact: Frame | None = None  # the last picture that the client has without loss
        self._rows = 0  # of `_shown` that have been sent without loss
        self._bytes_a_row = 0.0  # of those
        self._jpeg_bytes = 0  # of the last JPEG
        self._unmeasured = 0  # bytes of lossless frames since then
        self._wait = 0  # JPEGs to send until the lossless codings are tried again
        self._keys = 0  # of the coming frames, for so many a key frame is tried first
        self._calm = 0  # bytes that differences would have saved since they became small

    @property
    def exact(self) -> bool:
        """The client shows exactly the picture that was sent last."""
        return self._exact is self._shown

    def encode(self, frame: Frame, frame_id: int) -> bytes:
        """The bytes of one frame. `frame` is kept for the next difference and must not change afterwards."""
        if self._shown is not None and self._shown.shape != frame.shape:
            self.forget()
        if not self.lossy or max(frame.shape) > frames.LONGEST_JPEG_SIDE:
            data = self._unlimited(frame, self._exact, frame_id)
        elif self._shown is not None and not self.exact and _same(frame, self._shown):
            return self.sharpen(frame_id)
        else:
            chosen = self._cheapest(frame, frame_id)
            if chosen is None:
                self._shown, self._rows = frame, 0
                return frames.header(JPEG, frame, frame_id) + self._jpeg
            data = chosen
        self._shown = self._exact = frame
        self._unmeasured += len(data)
        return data

    def sharpen(self, frame_id: int) -> bytes:
        """The next rows of the picture that was sent last, without loss, in no more bytes than its JPEG.

        Call it only while `exact` is False.
        """
        shown = self._shown
        assert shown is not None
        first, left = self._rows, len(shown) - self._rows
        count = min(max(1, int(self._jpeg_bytes / (self._bytes_a_row or shown[0].nbytes))), left)
        while (body := frames.packed(shown[first : first + count], limit=self._jpeg_bytes)) is None and count > 1:
            count //= 2
        if body is None:
            body = _whole(shown[first : first + 1])
        self._bytes_a_row = max(1.0, len(body) / count)
        self._rows = first + count
        self._exact = shown if self._rows == len(shown) else None
        return frames.header(ROWS, shown, frame_id) + frames.FIRST_ROW.pack(first) + body

    def _cheapest(self, frame: Frame, frame_id: int) -> bytes | None:
        """A lossless coding that costs no more than a JPEG; if there is none, None, and `_jpeg` is this frame's."""
        data, measured = None, False
        trying = self.exact or self._wait == 0
        if not self._jpeg_bytes or self._unmeasured > _AGED * self._jpeg_bytes:
            self._measure(frame)
            measured = True
        if trying:
            data = self._lossless(frame, frame_id)
        if data is None and not measured:
            before = self._jpeg_bytes
            self._measure(frame)
            if trying and self._jpeg_bytes > _GREW * before:
                data = self._lossless(frame, frame_id)
        if trying and data is None:
            data = self._calmed(frame, frame_id)
            self._wait = _EVERY
        self._wait -= data is None
        return data

    def _measure(self, frame: Frame) -> None:
        self._jpeg = frames.jpeg(frame)
        self._jpeg_bytes = len(self._jpeg)
        self._unmeasured = 0

    def _lossless(self, frame: Frame, frame_id: int) -> bytes | None:
        """A difference or a key frame, if one of them is small enough."""
        bases = [None] if self._exact is None else [self._exact, None]
        if self._keys > 0:
            self._keys -= 1
            bases.reverse()
        for base in bases:
            body = frames.packed(frame, base, self._jpeg_bytes)
            if body is not None:
                if base is None and bases[0] is not None:
                    self._keys = _EVERY
                return frames.header(KEY if base is None else DIFFERENCE, frame, frame_id) + body
        return None

    def _calmed(self, frame: Frame, frame_id: int) -> bytes | None:
        """A key frame, whatever it costs, if differences have been small for so long that it pays."""
        if self._shown is None or self.exact:
            return None
        body = frames.packed(frame, self._shown, self._jpeg_bytes // 2)
        self._calm = self._calm + _EVERY * (self._jpeg_bytes - len(body)) if body is not None else 0
        if self._calm < _PATIENCE * frame.nbytes:
            return None
        self._calm = 0
        return self._unlimited(frame, None, frame_id)

    def _unlimited(self, frame: Frame, base: Frame | None, frame_id: int) -> bytes:
        return frames.header(KEY if base is None else DIFFERENCE, frame, frame_id) + _whole(frame, base)


def _whole(rows: Frame, base: Frame | None = None) -> bytes:
    body = frames.packed(rows, base)
    assert body is not None  # there is no limit
    return body


def _same(one: Frame, other: Frame) -> bool:
    """Whether the pixels are equal. Compares the rows in parts, and stops at the first difference."""
    at_once = max(1, 65_536 // one[0].nbytes)
    return all(
        np.array_equal(one[first : first + at_once], other[first : first + at_once])
        for first in range(0, len(one), at_once)
    )
