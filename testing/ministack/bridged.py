"""Puts the bridges of `bridge.py` in place. A forker of `testing/preloaded.py` imports it before all that the commands import."""

from testing.ministack import bridge

bridge.certificates()
bridge.internet()
bridge.account()
