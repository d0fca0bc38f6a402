"""Measures what Hippodrome costs and delivers: rows of figures, each beside its yardstick of the same run, if any."""
