"""The web server of `hippodrome run`."""
