"""A timer, every five minutes: removes what no open record owns, and sends lost messages again."""

from hippodrome.functions.sweep import handler

__all__ = ["handler"]
