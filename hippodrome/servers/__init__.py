"""The life of a participant's server: start, DNS name, termination, sweep, and the requests that are signed for it."""
