"""`doctor --rehearse --play N`: bots play a copy of a study on a real account, which proves what no emulator can."""

WITHIN = 20  # minutes that a rehearsal may take, without --within; about ten are usual
MAX_BOTS = 20
