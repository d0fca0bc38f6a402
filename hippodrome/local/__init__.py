"""Studies on one machine: the commands `make run`, `try`, `check` and `new`, and what replaces AWS there."""
