"""Copies a project's step pages, and the files beside them, from its folder into the data bucket, if they changed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.aws.documents import S3Documents
from hippodrome.control.config import layout
from hippodrome.control.participants.files import MAX_BYTES
from hippodrome.control.ports import Conflict
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.study.image.files import inside
from hippodrome.protocol.file_names import composed


@dataclass(frozen=True)
class Changes:
    """The differences between folder and bucket. `put`: by key, the file to upload. `gone`: keys without a file."""

    put: Mapping[str, Path]
    gone: Sequence[str]
    same: int

    def __bool__(self) -> bool:
        return bool(self.put or self.gone)


def compare(account: Account, bucket: str, project_id: str, folder: Path, more: Iterable[Path] = ()) -> Changes:
    """Compare folder and bucket. Changes nothing. `more` are pages outside of the folder.

    Raises `Problem` if a file is too large, or is a link out of the project folder.
    """
    prefix = f"{project_id}/steps/"
    files = {prefix + composed(file.name): file for file in [*_files(folder), *more]}
    stored = _listing(account, bucket, prefix)
    put = {key: file for key, file in files.items() if not _same(account, bucket, key, file, stored.get(key))}
    return Changes(put, sorted(stored.keys() - files.keys()), len(files) - len(put))


def upload(account: Account, bucket: str, changes: Changes) -> None:
    """Upload the pages that are new or different. After an interruption, the next `compare` finds the rest."""
    documents = _documents(account, bucket)
    with screen.ProgressBars() as progress:
        for key, file in progress.track(changes.put.items(), description="Uploading pages"):
            _put(documents, key, file.read_bytes())


def remove(account: Account, bucket: str, keys: Iterable[str]) -> None:
    """Remove pages that are not in the folder any more. Call it only when no registration names them."""
    documents = _documents(account, bucket)
    for key in keys:
        documents.delete(key)


def _files(folder: Path) -> list[Path]:
    """List the folder's files without hidden ones.

    Raises `Problem` on a link that leaves the folder, or a large file.
    """
    steps = layout.pages_folder(folder)
    files = sorted(file for file in steps.iterdir() if not file.name.startswith(".")) if steps else []
    page_paths = []
    for file in files:
        name = f"{file.parent.name}/{file.name}"
        if not inside(folder, file):
            raise Problem(
                f"{name} is a link out of the project folder.",
                "Everyone can read the files in this folder: put the file itself there, or remove the link.",
            )
        if not file.is_file():
            continue
        if file.stat().st_size > MAX_BYTES:
            raise Problem(
                f"{name} is larger than {MAX_BYTES // 1024**2} MB.",
                "Put it on a site of its own, name that site in allowedHosts, and link to it.",
            )
        page_paths.append(file)
    return page_paths


def _listing(account: Account, bucket: str, prefix: str) -> dict[str, Mapping[str, Any]]:
    pages = account.client("s3").get_paginator("list_objects_v2").paginate(Bucket=bucket, Prefix=prefix)
    return {line["Key"]: line for page in pages for line in page.get("Contents", ())}


def _same(account: Account, bucket: str, key: str, file: Path, stored: Mapping[str, Any] | None) -> bool:
    """Whether the object `stored`, from a listing, has the file's content.

    The ETag of an object from one PUT is its MD5, unless it is encrypted with a KMS key (S3 API Reference, Object). The
    object is read only if its ETag is another value.
    """
    if stored is None:
        return False
    body = file.read_bytes()
    if stored["Size"] != len(body):
        return False
    if stored["ETag"].strip('"') == hashlib.md5(body, usedforsecurity=False).hexdigest():
        return True
    document = _documents(account, bucket).get(key)
    return document is not None and document.body == body


def _documents(account: Account, bucket: str) -> S3Documents:
    return S3Documents(lambda: account.client("s3"), bucket)


def _put(documents: S3Documents, key: str, body: bytes) -> None:
    """Write the page, whatever is there: of two researchers who upload the same page, the later one wins."""
    while True:
        document = documents.get(key)
        try:
            if document is None:
                documents.create(key, body)
            elif document.body != body:
                documents.replace(key, body, document.etag)
        except Conflict:
            continue
        return
