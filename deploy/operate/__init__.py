"""What an administrator does while studies run: status, logs, doctor, stop, erase, data."""
