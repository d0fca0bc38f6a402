"""The core of a trial: every decision about a game step. Pure: no I/O, no threads, no clock."""
