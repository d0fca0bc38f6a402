"""Measures what a trial server delivers and costs: `python -m bench.trial`.

The yardstick of the encoding is HIPPO's (Pillow's JPEG, base64, JSON) on the same frames. What a participant sees is
measured in a real Chromium; its yardstick is the simplest server that answers a key with a picture (`bench/bare.py`),
in the same browser and run. The same script times both pages (`bench/seen.py`).
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Iterator, Sequence

import numpy as np

from bench import pictures, seen
from bench.load import LEAST_SHARE
from bench.table import Row, each, row
from testing.browser import chromium
from trial.pictures.encoder import Encoder
from trial.pictures.frames import DIFFERENCE, JPEG, KEY, Decoder, Frame, jpeg_message

ROUNDS = 3  # repetitions of each measurement of processor time; the quickest counts
IDLE_SECONDS = 5.0
RATES = (30, 60)  # frames a second
PRESSED_AT = 30  # frames a second while keys are pressed


# The encoding


def encoding() -> Iterator[Row]:
    """Measure bytes and processor time for each kind of picture, ours beside HIPPO's."""
    for kind, make in pictures.KINDS.items():
        frames = make()
        # The goal for Ms. Pac-Man, of which all frames arrive unchanged, is stricter than that for other pictures.
        flat = kind.startswith("Ms.")
        theirs, their_bytes, _ = cost(frames, None)
        ours, our_bytes, sent = cost(frames, Encoder(lossy=True))
        kinds = {name: sum(data[0] == number for data in sent) for number, name in _NAMES.items()}
        detail = {"frames": len(frames), "of them": kinds}
        yield row(
            f"CPU per frame, {kind}, against JPEG in JSON", ours, "ms", yardstick=theirs, at_most=0.2 if flat else 1.2
        )
        yield row(
            f"bytes per frame, {kind}, against JPEG in JSON",
            our_bytes,
            "bytes",
            yardstick=their_bytes,
            at_most=0.1 if flat else 1.2,
            detail=detail,
        )
        exact, exact_bytes, sent = cost(frames, Encoder())
        yield row(f"CPU per frame, {kind}, with `lossless: true`", exact, "ms", yardstick=theirs)
        yield row(f"bytes per frame, {kind}, with `lossless: true`", exact_bytes, "bytes", yardstick=their_bytes)
        yield row(
            f"frames that arrive unchanged with `lossless: true`, {kind}",
            unchanged(frames, sent),
            "share",
            at_least=1,
            bound="docs/wire.md promises it",
        )


_NAMES = {KEY: "key frames", DIFFERENCE: "differences", JPEG: "JPEGs"}


def cost(frames: Sequence[Frame], encoder: Encoder | None) -> tuple[float, float, list[bytes]]:
    """Encode the frames, in HIPPO's way without `encoder`; return ms CPU and bytes per frame, and the messages."""
    pack = encoder.encode if encoder is not None else lambda frame, number: jpeg_message(frame, number).encode()
    jpeg_message(frames[0], 0)  # so that its imports are not measured
    took = []
    sent: list[bytes] = []
    for turn in range(ROUNDS):
        if encoder is not None and turn:
            pack = Encoder(lossy=encoder.lossy).encode
        begun = time.thread_time()
        sent = [pack(frame, number) for number, frame in enumerate(frames)]
        took.append(1000 * (time.thread_time() - begun) / len(frames))
    return min(took), sum(map(len, sent)) / len(sent), sent


def unchanged(frames: Sequence[Frame], sent: Sequence[bytes]) -> float:
    """Return the share of the frames that are unchanged after decoding."""
    decoder = Decoder()
    return float(
        np.mean([np.array_equal(decoder.decode(data)[1], frame) for data, frame in zip(sent, frames, strict=True)])
    )


# In the browser


def in_chromium() -> Iterator[Row]:
    """Measure what participants see. Raises NoChromium."""
    with chromium() as browser:
        for picture in seen.AGENTS:
            yield from _seen(
                picture,
                seen.look(browser, seen.ours, picture, RATES, PRESSED_AT),
                seen.look(browser, seen.bare, picture, RATES, PRESSED_AT),
            )


def _seen(picture: str, ours: seen.Seen, bare: seen.Seen) -> Iterator[Row]:
    for rate in RATES:
        yield row(
            f"frames drawn at {rate}/s, {picture}, against a bare server",
            ours.share[rate],
            "of those due",
            yardstick=max(bare.share[rate], LEAST_SHARE),
            at_least=0.99,
            detail={"drawn of the bare server's": bare.share[rate], "the yardstick is at least": LEAST_SHARE},
        )
        yield row(
            f"time between two drawn frames at {rate}/s, {picture}, 99th percentile",
            ours.gaps[rate],
            "ms",
            yardstick=bare.gaps[rate],
        )
        yield row(
            f"server's CPU per drawn frame at {rate}/s, {picture}, game and recording included", ours.cpu[rate], "ms"
        )
    for name, quantile in (("p50", statistics.median), ("p95", _p95)):
        yield row(
            f"key to drawn effect at {PRESSED_AT}/s, {picture}, {name}, against a bare server",
            quantile(ours.waits),
            "ms",
            yardstick=quantile(bare.waits),
            at_most=1.25,
            detail={
                "presses": len(ours.waits),
                "measured": "in the page, from the browser's time of the key event to the draw that shows its effect",
                "the yardstick": "a WebSocket that sends a ready-made JPEG at each tick, decoded by the browser itself",
            }
            if name == "p50"
            else None,
        )


def _p95(waits: Sequence[float]) -> float:
    return statistics.quantiles(waits, n=20)[-1]


# The server without a participant


def waiting() -> Iterator[Row]:
    """Measure a server to which no participant is connected."""
    with seen.server(pictures.ROOT) as (_, pid):
        time.sleep(3.0)
        before = seen.cpu_seconds(pid)
        time.sleep(IDLE_SECONDS)
        share = (seen.cpu_seconds(pid) - before) / IDLE_SECONDS
    yield judged_idle(share)


def judged_idle(share: float) -> Row:
    """Return the row of a server without a participant, with its share of a core."""
    return row(
        "CPU without a connected participant",
        100 * share,
        "% of a core",
        at_most=1,
        bound="ours: a warm server needs hardly any processor time",
    )


def rows() -> Iterator[Row]:
    """Measure everything, one row after another; about four minutes."""
    yield from each((encoding, in_chromium, waiting))


if __name__ == "__main__":
    for found in rows():
        print(json.dumps(found), flush=True)
