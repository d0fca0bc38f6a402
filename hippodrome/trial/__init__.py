"""The trial server: runs the trial of one participant or one session, and talks to the browsers (docs/wire.md)."""
