"""The web server of `make run`."""
