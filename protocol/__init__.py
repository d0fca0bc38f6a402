"""What the control plane and a participant's server must agree on; both sides import it.

  trial.py, values.py    the `trial` section of config.yml: its keys, bounds and check
  environment.py         the environment variables that a server is started with
  handover.py            the document that tells a warm server its participant
  answer.py              the document with the answer to a step; for a game step, the server writes it
  keys.py                where these documents and the recordings lie
  exits.py               the exit codes of a server

It imports only the standard library, because it is part of the functions' zips and of the trial's image.
"""
