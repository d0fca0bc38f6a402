"""What the control plane and a participant's server must agree on; both sides import it.

  trial.py, trial_sections.py, trial_keys.py    the section `trial` of config.yml: its keys
  trial_check.py, trial_rules.py, values.py, players.py, key_maps.py    its check
  environment.py         the environment variables that a server is started with
  handover.py            the document that tells a warm server its participant
  session.py             the document that says who plays in a session, and the members' tokens
  answer.py              the document with the answer to a step; for a game step, the server writes it
  keys.py, times.py      where these documents and the recordings lie, and how they tell a time
  disk.py                how both sides write files on one machine, so that a power cut leaves none half written
  exits.py               the exit codes of a server
  keyboard.py            the names of keys
  similar.py             which known name was probably meant by an unknown one

It imports only the standard library, because it is part of the functions' zips and of the trial's image.
"""
