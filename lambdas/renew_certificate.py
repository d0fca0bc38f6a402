"""A timer, every day: renews the servers' certificate."""

from hippodrome.functions.renew_certificate import handler

__all__ = ["handler"]
