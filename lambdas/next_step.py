"""HTTP requests to `/next`, and for the studies' files: shows the page of the due step and stores answers."""

from hippodrome.functions.next_step import handler

__all__ = ["handler"]
