"""HTTP requests of trial servers to `/sign`: presigns requests for their own documents."""

from hippodrome.functions.sign_requests import handler

__all__ = ["handler"]
