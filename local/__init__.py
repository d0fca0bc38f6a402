"""The ports on one machine, and the web server of `make run`: what the functions stand on where there is no AWS."""
