"""The ports of `hippodrome/ports.py` on files, processes and threads of one machine."""
