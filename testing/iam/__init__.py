"""Judges every AWS call of every function by the function's role in the template."""
