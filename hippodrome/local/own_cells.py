"""Links for trying the cells of `conditions`: `&cell=helpful,on` gives a new participant, or a new session, this cell.

Only the web server of one machine knows `cell`: it assigns the participant before `next_step` is called, which knows
nothing of it. On AWS the cell of a participant is always drawn.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from hippodrome.control import http
from hippodrome.control.model import ids
from hippodrome.control.model.design import cell_name, cells
from hippodrome.control.model.project import Project
from hippodrome.control.participants import frame
from hippodrome.control.participants.assigning import Assigning
from hippodrome.control.ports import Platform
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache

FIELD = "cell"
SHOWN = 12  # links that are printed
Handler = Callable[[dict[str, Any], object], dict[str, Any]]


def cell_names(project: Project) -> list[str]:
    """Return the names of the cells of `conditions`, such as "helpful,on"; none if there are no conditions."""
    return [cell_name(levels) for levels in cells(project.conditions)] if project.conditions else []


class OwnCells:
    """Answers requests as `next_step` does, after the participant got the cell that their link names."""

    def __init__(self, platform: Platform, next_step: Handler) -> None:
        self._platform = platform
        self._next_step = next_step

    def handler(self, event: dict[str, Any], context: object) -> dict[str, Any]:
        query = event.get("queryStringParameters") or {}
        if FIELD in query and (refused := self._assign(query)) is not None:
            return refused
        return self._next_step(event, context)

    def _assign(self, query: dict[str, str]) -> dict[str, Any] | None:
        """Give a new participant the cell. Return a page that says which cells there are, if the link's is none."""
        project_id, user_id, cell = query.get("projectId"), query.get("userId"), query[FIELD]
        project = self._project(project_id) if ids.is_project_id(project_id) else None
        names = cell_names(project) if project is not None else []
        if project is None or not names:
            return None
        if cell not in names:
            text = f"cell is one of {'; '.join(names)}."
            page = frame.message_page(f"The study has no cell {cell}", text)
            return http.html(404, page.html, page.headers).to_event()
        if user_id is None or not ids.is_user_id(user_id):
            return None  # the request is redirected to an address with an id
        repository = Repository(self._platform.documents)
        if repository.assignment(project.id, user_id) is None:
            Assigning(self._platform, repository).assign(project, user_id, cell)
        return None

    def _project(self, project_id: Any) -> Project | None:
        return ProjectCache(self._platform, SecretCache(self._platform.documents)).project(project_id)
