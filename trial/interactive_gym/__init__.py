"""Runs experiments that were written for Interactive Gym, with its modules and names.

`from trial import RemoteConfig`, and the other names in `trial.__getattr__`, import modules of this package.
docs/interactive-gym.md says what each option becomes here. On the researcher's machine `server_app.run(config)` makes
a project from the experiment (`project.py`). On a participant's server the project's agent.py loads the experiment's
file (`on_server.py`).
"""
