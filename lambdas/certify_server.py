"""HTTP requests of trial servers without a DNS name to `/certificate`: orders certificates for their addresses."""

from hippodrome.functions.certify_server import handler

__all__ = ["handler"]
