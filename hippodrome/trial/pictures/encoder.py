"""Chooses the coding of each frame of a connection (docs/wire.md, "A binary frame"). Pure."""

from __future__ import annotations

import numpy as np

from hippodrome.trial.pictures import frames
from hippodrome.trial.pictures.frames import DIFFERENCE, JPEG, KEY, ROWS, Frame

_RETRY_AFTER = 16  # after so many frames, a coding that was too large is tried again
_MEASURE_AFTER = 8  # after lossless frames as large as so many JPEGs, a JPEG is made again, to know its size
_GROWN = 1.25  # if a JPEG is this many times as large as the last one, the lossless codings are tried again
_SAVINGS = 4  # once differences would have saved the bytes of so many raw pictures, a key frame is sent


class Encoder:
    """Encodes the frames of one connection.

    Without `lossy` every frame is exact: a key frame, or a difference to the frame before it.

    With `lossy`, `encode` sends a JPEG unless a difference or a key frame takes no more bytes. Packing stops as soon as
    the result is larger than the last JPEG. Packing (by isal) is quick if the result is small: whenever it was smaller
    than the JPEG, it took no longer either. So the number of
    bytes decides, and the same frames give the same bytes on every machine. A coding that was too large is tried again
    sixteen frames later.

    A difference refers to the last exact picture, which the client keeps. It never refers to a JPEG, since decoders
    differ. A picture that does not change any more becomes exact by rows (`sharpen`).
    """

    def __init__(self, *, lossy: bool = False) -> None:
        self.lossy = lossy
        self._begin()

    def forget(self) -> None:
        """Let the next frame be encoded whole, since the client was shown something else."""
        if self._shown is not None:
            self._begin()

    def _begin(self) -> None:
        self._shown: Frame | None = None  # the picture sent last, in any coding
        self._exact: Frame | None = None  # the last picture that the client has without loss
        self._exact_rows = 0  # the number of rows of `_shown` that the client has without loss
        self._bytes_a_row = 0.0  # the bytes of such a row when rows were last sent
        self._jpeg = b""  # the last JPEG
        self._unmeasured = 0  # bytes of lossless frames since that JPEG
        self._jpegs_left = 0  # JPEGs to send until the lossless codings are tried again
        self._keys_first = 0  # frames for which a key frame is tried before a difference
        self._saved = 0  # bytes by which differences have been smaller than the JPEGs sent instead, in a row

    @property
    def exact(self) -> bool:
        """Whether the client has the last picture without loss, from one exact frame or from all of its rows."""
        return self._exact is self._shown

    def encode(self, frame: Frame, frame_id: int) -> bytes:
        """Encode one frame, and return its bytes.

        `frame` is kept for the next difference, so it must not be changed.
        """
        if self._shown is not None and self._shown.shape != frame.shape:
            self.forget()
        if not self.lossy or max(frame.shape) > frames.MAX_JPEG_SIDE:
            data = self._unlimited(frame, self._exact, frame_id)
        elif self._shown is not None and not self.exact and _same(frame, self._shown):
            return self.sharpen(frame_id)
        else:
            chosen = self._cheapest(frame, frame_id)
            if chosen is None:
                self._shown, self._exact_rows = frame, 0
                return frames.header(JPEG, frame, frame_id) + self._jpeg
            data = chosen
        self._shown = self._exact = frame
        self._unmeasured += len(data)
        return data

    def sharpen(self, frame_id: int) -> bytes:
        """Return the next rows of the picture that was sent last, without loss: at most as many bytes as its JPEG has.

        One row may be larger than that. Call it only while `exact` is False.
        """
        shown = self._shown
        assert shown is not None
        first, left = self._exact_rows, len(shown) - self._exact_rows
        count = min(max(1, int(len(self._jpeg) / (self._bytes_a_row or shown[0].nbytes))), left)
        while (body := frames.packed(shown[first : first + count], limit=len(self._jpeg))) is None and count > 1:
            count //= 2
        if body is None:
            body = _whole(shown[first : first + 1])
        self._bytes_a_row = max(1.0, len(body) / count)
        self._exact_rows = first + count
        self._exact = shown if self._exact_rows == len(shown) else None
        return frames.header(ROWS, shown, frame_id) + frames.FIRST_ROW.pack(first) + body

    def _cheapest(self, frame: Frame, frame_id: int) -> bytes | None:
        """Return a lossless coding that takes no more bytes than a JPEG. If it is None, `_jpeg` is the frame's JPEG."""
        data, measured = None, False
        trying = self.exact or self._jpegs_left == 0
        if not self._jpeg or self._unmeasured > _MEASURE_AFTER * len(self._jpeg):
            self._measure(frame)
            measured = True
        if trying:
            data = self._lossless(frame, frame_id)
        if data is None and not measured:
            before = len(self._jpeg)
            self._measure(frame)
            if trying and len(self._jpeg) > _GROWN * before:
                data = self._lossless(frame, frame_id)
        if trying and data is None:
            data = self._key_that_pays(frame, frame_id)
            self._jpegs_left = _RETRY_AFTER
        self._jpegs_left -= data is None
        return data

    def _measure(self, frame: Frame) -> None:
        self._jpeg = frames.jpeg(frame)
        self._unmeasured = 0

    def _lossless(self, frame: Frame, frame_id: int) -> bytes | None:
        """Return a difference or a key frame, if one of them takes no more bytes than the last JPEG."""
        bases = [None] if self._exact is None else [self._exact, None]
        if self._keys_first > 0:
            self._keys_first -= 1
            bases.reverse()
        for base in bases:
            body = frames.packed(frame, base, len(self._jpeg))
            if body is not None:
                if base is None and bases[0] is not None:
                    self._keys_first = _RETRY_AFTER
                return frames.header(KEY if base is None else DIFFERENCE, frame, frame_id) + body
        return None

    def _key_that_pays(self, frame: Frame, frame_id: int) -> bytes | None:
        """Return a key frame of any size if differences have been small for long: it makes them possible again."""
        if self._shown is None or self.exact:
            return None
        body = frames.packed(frame, self._shown, len(self._jpeg) // 2)
        self._saved = self._saved + _RETRY_AFTER * (len(self._jpeg) - len(body)) if body is not None else 0
        if self._saved < _SAVINGS * frame.nbytes:
            return None
        self._saved = 0
        return self._unlimited(frame, None, frame_id)

    def _unlimited(self, frame: Frame, base: Frame | None, frame_id: int) -> bytes:
        return frames.header(KEY if base is None else DIFFERENCE, frame, frame_id) + _whole(frame, base)


def _whole(rows: Frame, base: Frame | None = None) -> bytes:
    body = frames.packed(rows, base)
    assert body is not None  # `packed` returns None only at a limit, and here is none
    return body


def _same(one: Frame, other: Frame) -> bool:
    """Whether the pixels are equal. It compares some rows at a time, and stops at the first difference."""
    count = max(1, 65_536 // one[0].nbytes)
    return all(
        np.array_equal(one[first : first + count], other[first : first + count]) for first in range(0, len(one), count)
    )
