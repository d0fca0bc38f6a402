"""Handles participants' HTTP requests: pages, answers, the state of their server, and the relays."""
