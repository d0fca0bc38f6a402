"""HTTP requests to `/start`: publishes a participant's start message."""

from hippodrome.functions.send_start_server_message import handler

__all__ = ["handler"]
