"""What the control plane and a participant's server must agree on: the `trial` section of config.yml, and exit codes.

Both sides import it. It imports only the standard library, because it is part of the functions' zips and of the
trial's image.
"""
