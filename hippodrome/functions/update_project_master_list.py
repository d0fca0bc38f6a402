"""Direct invocation: adds or replaces a project in `project_master_list.json`, or signs links."""

from typing import Any

from hippodrome.control import registry
from hippodrome.functions import installed


def handler(event: dict[str, Any], context: object) -> dict[str, Any]:
    """Register the project in `{"project": registration}`; return `{"registered": …}` or `{"problems": […]}`.

    `registry.handle` describes the other events.
    """
    return registry.handle(installed.platform(), event)
