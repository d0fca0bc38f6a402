"""Definitions that the control plane and trial servers share; both sides import this package.

  section_keys.py        how the keys of config.yml are declared and checked
  trial.py, trial_sections.py    the keys of the section `trial` of config.yml
  trial_check.py, values.py, players.py    the checks of this section
  environment.py         the environment variables that a server is started with
  handover.py            the document that tells a warm server its participant
  session.py             the document that says who plays in a session, and the members' tokens
  answer.py              the document with the answer to a step; for a game step, the server writes it
  keys.py                the keys of these documents and of the recordings
  times.py               how documents and recordings write a time
  disk.py                how both sides write files on one machine, so that a power cut leaves none half written
  exits.py               the exit codes of a server
  keyboard.py            the names of keys, and the maps of `trial` by key, action or player
  server_modules.py      the modules that every server imports, which no file of a researcher may hide
  similar.py             which known name was probably meant by an unknown one

The package imports only the standard library, because it is part of the functions' zips and of the servers' image.
"""
