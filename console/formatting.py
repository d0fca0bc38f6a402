"""Numbers as people read them."""

from __future__ import annotations

LONG = 90  # seconds; from here on minutes are told


def count(number: int, what: str) -> str:
    """`1 server`, `1,200 servers`."""
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


def size(number: float) -> str:
    """Bytes as `812 bytes`, `1.5 KB`, `3.2 GB`; a KB is a thousand of them."""
    if number < 1000:
        return count(round(number), "byte")
    for unit in ("KB", "MB"):
        number /= 1000
        if number < 999.95:
            return f"{number:,.1f} {unit}"
    return f"{number / 1000:,.1f} GB"


def duration(seconds: float) -> str:
    """`41 s`, `12 min`."""
    return f"{seconds:.0f} s" if seconds < LONG else f"{seconds / 60:.0f} min"
