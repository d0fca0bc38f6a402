"""The receipt of an erasure: what was deleted, when and by whom. It names the participant by a salted hash only."""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hippodrome.console.problem import Problem
from hippodrome.control.lobby import decisions, entries
from hippodrome.control.model import ids
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.object_version import Version
from hippodrome.protocol.keys import QUESTIONS, groups_folder, participant_folder, sessions_folder

NOT_COVERED = (
    "Downloaded copies: `hippodrome data` into the same folder removes this participant there too.",
    "Messages about their server that are still in a queue; SQS deletes them, dead letters after 14 days at most.",
    "Older versions of the lists of who holds a slot where slots are limited: hashes, soon deleted by the bucket.",
    "AWS's own records: ECS shows a stopped task for about an hour, CloudTrail may keep the call that ran it 90 days.",
    "What the recruiter knows of them.",
)


@dataclass
class ProjectReceipt:
    """One project's part of a receipt: how many documents and resources were removed, and what the last look found."""

    project: str
    user: str
    deleted: dict[str, dict[str, int]] = field(default_factory=dict)
    keys: dict[str, int] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=lambda: {"tasks": 0, "timers": 0, "names": 0, "clusters": 0})
    rounds: int = 0
    rewritten: int = 0  # recordings of sessions, which stay for the other members
    remains: Mapping[str, int] | None = None
    looked: datetime | None = None

    def note(self, versions: Iterable[Version]) -> None:
        """Count these deleted versions."""
        for version in versions:
            kind = self._kind(version.key)
            counts = self.deleted.setdefault(kind, {"versions": 0, "deleteMarkers": 0, "uploads": 0, "bytes": 0})
            counts["uploads" if version.upload else "deleteMarkers" if version.marker else "versions"] += 1
            counts["bytes"] += version.size
            shown = self._nameless(version.key)
            self.keys[shown] = self.keys.get(shown, 0) + 1

    def as_json(self) -> dict[str, Any]:
        """Return this part of the receipt as JSON data, without the participant's id."""
        return {
            "project": self.project,
            "deleted": self.deleted,
            "letGo": self.removed,
            "keys": self.keys,
            **({"rewritten": self.rewritten} if self.rewritten else {}),
            "rounds": self.rounds,
            "remains": self.remains,
            "listed": _time(self.looked),
        }

    def _kind(self, key: str) -> str:
        rest = key.removeprefix(participant_folder(self.project, self.user))
        if key.startswith(sessions_folder(self.project)):
            return "sessions"
        if key.startswith((entries.FOLDER, decisions.LOBBIES, QUESTIONS, groups_folder(self.project))):
            return "lobby"
        if rest == key:
            return "server record"
        if rest == "participant.json":
            return "participant"
        kinds = {"answers": "answers", "trials": "recordings"}
        return kinds.get(rest.partition("/")[0], "other")

    def _nameless(self, key: str) -> str:
        """Remove the participant's id from the key, and the server's label, which is computed from the id."""
        rest = key.removeprefix(participant_folder(self.project, self.user))
        if key.startswith(sessions_folder(self.project)):  # a session's id is random, and names no member
            return "/".join("{userId}" if self.user in part else part for part in key.split("/"))
        if key.startswith(entries.FOLDER):
            return f"{entries.folder(self.project)}{{participant}}"
        if key.startswith((decisions.LOBBIES, QUESTIONS, groups_folder(self.project))):
            return key
        if rest == key:
            return f"{key.rpartition('/')[0]}/{{server}}.json"
        rest = rest.replace(ids.server_label(self.project, self.user), "{server}")
        rest = "/".join("{userId}" if self.user in part else part for part in rest.split("/"))
        return f"{self.project}/users/{{userId}}/{rest}"


def receipt(
    parts: Sequence[ProjectReceipt],
    user: str,
    account: Account,
    installation: Installation,
    *,
    began: datetime,
    whole: bool,
    with_id: bool,
) -> dict[str, Any]:
    """Make the receipt, as JSON data. `whole`: whether the last look found nothing.

    `with_id`: include the id itself.
    """
    salt = secrets.token_hex(16)
    person = {
        "salt": salt,
        "sha256": hashlib.sha256(f"{salt}{user}".encode()).hexdigest(),
        "check": "sha256 of the salt followed by the id",
    }
    return {
        "schema": 1,
        "what": "erasure of a participant's data",
        "complete": whole,
        "person": {**person, "userId": user} if with_id else person,
        "stack": installation.stack,
        "region": installation.region,
        "bucket": installation["Bucket"],
        "by": account.identity["Arn"],
        "began": _time(began),
        "ended": _time(datetime.now(UTC)),
        "projects": [part.as_json() for part in parts],
        "notCovered": list(NOT_COVERED),
    }


def write(target: Path, receipt: Mapping[str, Any]) -> None:
    """Write the receipt into a new file. Raises `Problem` if that fails."""
    try:
        with target.open("x", encoding="utf-8") as file:
            json.dump(receipt, file, indent=1)
            file.write("\n")
    except OSError as error:
        raise Problem(
            f"The receipt could not be written: {error.strerror}.",
            "Run the command again: it writes another one, of a listing that finds nothing.",
        ) from None


def _time(moment: datetime | None) -> str | None:
    return None if moment is None else moment.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
