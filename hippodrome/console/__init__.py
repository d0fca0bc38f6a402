"""Output, problems, exit codes and the formatting of numbers, for all commands that people run in a terminal."""
