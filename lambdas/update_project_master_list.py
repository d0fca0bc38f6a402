"""Direct invocation by `register`: writes a project into `project_master_list.json`."""

from hippodrome.functions.update_project_master_list import handler

__all__ = ["handler"]
