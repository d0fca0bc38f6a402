"""Studies on one machine: the commands `hippodrome run`, `try`, `check` and `new`, and what replaces AWS there."""
