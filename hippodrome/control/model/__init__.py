"""Records and their transitions: pure, with no clock and no I/O."""
