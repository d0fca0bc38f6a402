"""What runs have fetched: in the folder's `private/records/`, a JSON file for each participant and each session.

So an interrupted run can be continued, memory holds one participant at a time, and tables need no source. The files
hold ids and answers. One that is missing or damaged is made again from the source.
"""

from __future__ import annotations

import csv
import itertools
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from hippodrome.export.keys import ASSIGNED, ENDED, KeyKind
from hippodrome.export.manifest import ExportedFile
from hippodrome.export.scrub import Scrub, clean, texts
from hippodrome.protocol.answer import GAME
from hippodrome.protocol.session import is_session_id

PRIVATE = "private"
IDENTITIES = f"{PRIVATE}/identities.csv"
STRAYS = "~"
"""The name of the record of files that are neither a participant's nor a session's."""
_LETTERS = "abcdefghjkmnpqrstuvwxyz23456789"  # characters that are not mistaken for others


@dataclass
class SourceFile:
    """A file of the source, and the result of fetching it."""

    key: str
    kind: str
    version: str
    step: str = ""  # of an answer
    made: ExportedFile | None = None  # the converted recording
    raw: ExportedFile | None = None  # the unchanged copy
    document: Mapping[str, Any] | None = None  # the content; of a tape what tables need of it; of a recording None
    frames: int = 0
    episodes: list[Mapping[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    @property
    def path(self) -> str:
        """The path of the converted recording in the export folder; "" if there is none."""
        return self.made.path if self.made else ""

    @property
    def exported(self) -> list[ExportedFile]:
        """Its files in the export folder."""
        return [file for file in (self.made, self.raw) if file]


@dataclass
class Record:
    """The files of one participant or one session. `number` replaces a participant's id; `folder` is the name of their
    folder in the export folder. A session has its id in all three."""

    user: str
    number: str
    folder: str
    files: dict[str, SourceFile] = field(default_factory=dict)
    """By key."""

    @property
    def is_session(self) -> bool:
        return is_session_id(self.user)

    @property
    def is_participant(self) -> bool:
        return bool(self.user) and not self.is_session

    def _of(self, kind: KeyKind) -> Mapping[str, Any]:
        return next((file.document or {} for file in self.files.values() if file.kind == kind), {})

    @property
    def document(self) -> Mapping[str, Any]:
        """The content of participant.json; {} without it."""
        return self._of(KeyKind.PARTICIPANT)

    @property
    def membership(self) -> Mapping[str, Any]:
        """The content of a participant's session.json, which names their session; {} if they have none."""
        return self._of(KeyKind.MEMBERSHIP)

    @property
    def session(self) -> Mapping[str, Any]:
        """The content of a session's session.json."""
        return self._of(KeyKind.SESSION)

    @cached_property
    def documents(self) -> dict[str, Mapping[str, Any]]:
        """The documents of a participant's answers, tries, assignment and end, by step."""
        files = sorted(
            (file for file in self.files.values() if file.kind == KeyKind.ANSWER), key=lambda file: file.step
        )
        return {file.step: file.document for file in files if file.document is not None} if self.is_participant else {}

    @cached_property
    def answers(self) -> dict[str, Mapping[str, Any]]:
        """The documents of a participant's answers, by step."""
        return {step: document for step, document in self.documents.items() if is_answer(step)}

    @cached_property
    def failed_code(self) -> str:
        """The completion code that a participant saw because no server could run their game; "" if there is none."""
        for document in self.documents.values():
            fields = document.get("answers")
            code = fields.get("completionCode") if isinstance(fields, dict) and document.get("page") == GAME else None
            if isinstance(code, str):
                return code
        return ""

    @property
    def _codes(self) -> list[str]:
        """The participant's codes, first the one that they were shown: that of a game that failed comes before that of
        an unmatched participant, in `session.json`, and this before that in `participant.json`."""
        documents = (document.get("completionCode") for document in (self.membership, self.document))
        return [code for code in (self.failed_code, *documents) if isinstance(code, str) and code]

    @property
    def completion_code(self) -> str | None:
        """The completion code that the participant was shown."""
        return next(map(clean, self._codes), None)

    @property
    def identities(self) -> dict[str, str]:
        """The texts that identify the participant, each with its replacement: the id, the values of the link, and the
        completion codes."""
        link = {value: f"({name})" for name, value in texts(self.document.get("link")).items()}
        return {**link, **dict.fromkeys(self._codes, "(completionCode)"), self.user: self.number}

    def recordings(self) -> list[SourceFile]:
        """The converted recordings, in the order of their paths."""
        return sorted((file for file in self.files.values() if file.made), key=lambda file: file.path)

    def tapes(self) -> list[Mapping[str, Any]]:
        """The pieces of tapes; those of one game follow each other, in the order in which they were made."""
        tapes = [(file.document, file.key) for file in self.files.values() if file.kind == KeyKind.TAPE]
        ordered = sorted(
            ((piece["step"], piece["attempt"] or 0, len(key), key), piece) for piece, key in tapes if piece is not None
        )
        return [piece for _, piece in ordered]

    def without_identities(self) -> int:
        """Replace the participant's identities in their answers; return how many were replaced. An assignment and an
        end hold words of the study alone."""
        hide = Scrub(self.identities)
        for step, document in self.documents.items():
            if step not in (ASSIGNED, ENDED):
                self.documents[step] = hide.value(document)
        return hide.found


def is_answer(step: str) -> bool:
    """Return whether a document is an answer: neither a try, nor an assignment or an end."""
    return "." not in step and step not in (ASSIGNED, ENDED)


class Records:
    """The records in an export folder. With `apart`, participants have random numbers instead of their ids, which
    `identities.csv` keeps. Threads may read and write different records at once."""

    def __init__(self, folder: Path, *, apart: bool, dry: bool = False) -> None:
        self._folder = folder
        self._place = folder / PRIVATE / "records"
        self._dry = dry  # whether nothing may be written
        self._numbers = self._read_numbers() if apart else None
        self.names = {path.stem for path in self._place.glob("*.json")}
        self._taken = {name.casefold() for name in self.names}

    def _read_numbers(self) -> dict[str, str]:
        try:
            with (self._folder / IDENTITIES).open(encoding="utf-8-sig", newline="") as file:
                rows = [(row.get("userId") or "", row.get("participant") or "") for row in csv.DictReader(file)]
        except FileNotFoundError:
            return {}
        return {user.removeprefix("'"): number for user, number in rows if user and number}

    def number_of(self, user: str) -> str:
        """Return the participant's number. A new random one is in `identities.csv` before anything else has it."""
        if self._numbers is None:
            return user
        if user not in self._numbers:
            self._numbers[user] = "p" + "".join(secrets.choice(_LETTERS) for _ in range(9))
            self._append(f"{self._numbers[user]},{user}\r\n")
        return self._numbers[user]

    def _append(self, line: str) -> None:
        if self._dry:
            return
        path = self._folder / IDENTITIES
        with path.open("a", encoding="utf-8", newline="") as file:
            file.write(line if file.tell() else f"participant,userId\r\n{line}")

    def of(self, user: str) -> Record:
        """Return the record of a participant or session; an empty one if there is none, or if it is damaged."""
        if not user or is_session_id(user):
            self.names.add(user or STRAYS)
            return self.load(user or STRAYS) or Record(user, "", user or STRAYS)
        number = self.number_of(user)
        # Names that differ only by case are one file on some systems.
        for folder in itertools.chain([number], (f"{number}~{count}" for count in itertools.count(2))):
            if folder in self.names:
                record = self.load(folder) or Record(user, number, folder)
                if record.user == user:
                    return record
            elif folder.casefold() not in self._taken:
                break
        self.names.add(folder)
        self._taken.add(folder.casefold())
        return Record(user, number, folder)

    def load(self, name: str) -> Record | None:
        try:
            saved = json.loads((self._place / f"{name}.json").read_text())
            for file in saved["files"]:
                file |= {part: ExportedFile(*file[part]) if file[part] else None for part in ("made", "raw")}
            files = {file["key"]: SourceFile(**file) for file in saved["files"]}
            return Record(saved["user"], saved["number"], name, files)
        except (FileNotFoundError, ValueError, KeyError, TypeError):
            return None

    def save(self, record: Record) -> None:
        """Write a record, whole or not at all."""
        saved = {"user": record.user, "number": record.number, "files": [vars(file) for file in record.files.values()]}
        part = self._place / f"{record.folder}.part"
        part.write_text(json.dumps(saved, separators=(",", ":")))
        os.replace(part, self._place / f"{record.folder}.json")

    def remove(self, name: str) -> None:
        """Remove the record with this name."""
        (self._place / f"{name}.json").unlink(missing_ok=True)
        self.names.discard(name)

    def __iter__(self) -> Iterator[Record]:
        """Read the records one after the other: those of sessions by id, then those of participants by number."""
        for name in sorted(self.names, key=lambda name: (not is_session_id(name), name)):
            if (record := self.load(name)) is not None:
                yield record
