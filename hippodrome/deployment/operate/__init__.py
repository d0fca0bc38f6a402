"""The commands for the time while studies run: status, logs, doctor, stop, erase, data."""
