"""Every decision of a trial. Pure: no I/O, no threads, no clock."""
