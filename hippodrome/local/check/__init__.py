"""`hippodrome check`: finds the mistakes of a project before participants come."""
