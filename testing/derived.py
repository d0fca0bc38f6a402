"""Derives tokens and project secrets from stored documents, for tests that have only those."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from hippodrome.model.project import Project
from hippodrome.model.records import from_data, from_json
from hippodrome.model.server import Server
from hippodrome.storage.secret import Secret


def project_secret(kept: bytes, project: Mapping[str, Any]) -> str:
    """The secret that signs this project's tickets. `kept` is `_secret.json`, `project` an entry of the master list."""
    return from_json(kept, Secret).project_secret(from_data(project, Project))


def token(kept: bytes, record: Mapping[str, Any]) -> str:
    """The token of the server of this record. `kept` is `_secret.json`."""
    return from_json(kept, Secret).token(from_json(json.dumps(record).encode(), Server))
