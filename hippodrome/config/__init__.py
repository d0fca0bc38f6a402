"""A researcher's `config.yml`: read, checked in full, and turned into the registration that everything else works with.

A folder's file (`project`) and a message from outside (`registration`) go the same way: each value by itself (`tree`,
by the `models`), values against each other (`checks`), and for a folder the step files (`steps`). A value that fails
is left out of the later passes, so that all mistakes come at once. Only `read_project` imports PyYAML (in `lines`).
"""

from hippodrome.config.problems import ConfigErrors, Problem
from hippodrome.config.project import Config, StepFiles, read_project
from hippodrome.config.registration import parse_registration
from hippodrome.config.schema import config_schema

__all__ = ["Config", "ConfigErrors", "Problem", "StepFiles", "config_schema", "parse_registration", "read_project"]
