"""The ports of `hippodrome/control/ports.py` on files, processes and threads of one machine."""
