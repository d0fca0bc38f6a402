"""`doctor --rehearse --play N`: bots in a copy of a study, on a real account, prove what no emulator can."""

WITHIN = 20  # minutes that a rehearsal may take, unless told; about ten are usual
MAX_BOTS = 20
