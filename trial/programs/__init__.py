"""The path /gym of a trial server, for programs that watch, advise, or use environments."""
