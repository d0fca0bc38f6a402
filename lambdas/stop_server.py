"""The stop queue: stops servers and removes what belongs to them."""

from hippodrome.functions.stop_server import handler

__all__ = ["handler"]
