"""Runs experiments that were written for Interactive Gym: `python -m hippodrome.trial.interactive_gym experiment.py`.

`script.py` runs the experiment's own script, in which Interactive Gym's module names lead to modules of this package,
until it calls `run`. On the researcher's machine `project.py` then makes a project of the experiment; `options.py` has
the key of config.yml for each option. On a participant's server, the project's agent.py runs the script once more, and
`playing.py` calls its functions. docs/interactive-gym.md is for researchers.
"""
