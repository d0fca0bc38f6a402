"""Reads and checks a researcher's `config.yml`, and makes the project's registration from it.

The same checks run for a project folder (`folder`) and for a registration from outside (`registration`): first each
value by itself (`each_value`, with `project_keys` and `hippodrome.protocol.trial`), then values against each other
(`consistency`), and in a folder the step files (`step_files`). A value with a mistake is left out of the later checks,
so that all mistakes are reported at once. A project without mistakes becomes a `Config`. PyYAML is imported
(in `yaml_file`) only when a project folder is read.
"""

from hippodrome.control.config.config import Config, StepFiles
from hippodrome.control.config.diagnostics import ConfigErrors, Diagnostic
from hippodrome.control.config.folder import read_project
from hippodrome.control.config.registration import parse_registration
from hippodrome.control.config.schema import config_schema

__all__ = ["Config", "ConfigErrors", "Diagnostic", "StepFiles", "config_schema", "parse_registration", "read_project"]
