"""Tokens and project secrets computed from stored documents, for tests that have only those documents."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_data, from_json
from hippodrome.control.model.server import Server
from hippodrome.control.storage.secret import Secret


def project_secret(secret: bytes, project: Mapping[str, Any]) -> str:
    """Return the secret that signs a project's tickets. `secret` is `_secret.json`, `project` a master list's entry."""
    return from_json(secret, Secret).project_secret(from_data(project, Project))


def token(secret: bytes, record: Mapping[str, Any]) -> str:
    """Return the token of the server with this record. `secret` is `_secret.json`."""
    return from_json(secret, Secret).token(from_json(json.dumps(record).encode(), Server))
