"""Draws a sentence as a picture, for pages that show only frames while they wait. Pure."""

from __future__ import annotations

import textwrap
from functools import lru_cache

import numpy as np

from hippodrome.trial.pictures import frames

_SIZE = 600, 400  # pixels; HIPPO's page shows frames in about this shape
_LETTER = 26  # pixels
_COLUMNS = 38  # letters in a line


@lru_cache(maxsize=8)
def frame_message(words: str) -> str:
    """Build a message with a frame that shows the words, in the form for clients without a subprotocol."""
    from PIL import Image, ImageDraw, ImageFont  # noqa: PLC0415 - only for such clients

    picture = Image.new("RGB", _SIZE, "white")
    text = "\n".join(textwrap.wrap(words, _COLUMNS))
    font = ImageFont.load_default(_LETTER)
    ImageDraw.Draw(picture).multiline_text((_SIZE[0] / 2, _SIZE[1] / 2), text, "black", font, "mm", spacing=10)
    return frames.jpeg_message(np.asarray(picture), 1)
