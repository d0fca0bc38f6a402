"""The trial server: runs one participant's trial and talks to their browser. Stands alone; see docs/wire.md."""
