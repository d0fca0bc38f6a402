"""The start queue: starts servers, each with its shutdown timer."""

from hippodrome.functions.start_server import handler

__all__ = ["handler"]
