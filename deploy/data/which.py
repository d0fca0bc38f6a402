"""Which study a command is about."""

from __future__ import annotations

from pathlib import Path

from deploy.problem import Problem
from hippodrome import ids


def project_id(given: str | None) -> str:
    """`--project`, or the id in this folder's config.yml. Raises `Problem` if there is neither, or it is no id."""
    from deploy.study import id_in  # noqa: PLC0415 - pydantic, only where nobody says which

    found = given if given is not None else id_in(Path("."))
    if found is None:
        raise Problem("Which project?", "Name it with --project, or run this in the project's folder.")
    if not ids.is_project_id(found):
        raise Problem(f"{found!r} is no project's id.", "An id has letters, digits and dashes, 64 at most.")
    return found
