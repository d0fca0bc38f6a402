"""Experiments written for Interactive Gym: its configuration, its words, and what becomes of them here.

`from trial import RemoteConfig` and the names in `trial.__getattr__` lead here. docs/interactive-gym.md tells what each
option becomes. On the researcher's machine `server_app.run(config)` makes a project of the experiment (`project.py`);
on a participant's server that project's agent.py loads the experiment's file (`on_server.py`).
"""
