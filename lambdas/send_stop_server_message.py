"""HTTP requests to `/stop`: publishes a participant's stop message."""

from hippodrome.functions.send_stop_server_message import handler

__all__ = ["handler"]
