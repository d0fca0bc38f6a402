"""The keys of our accounts at ACME certificate authorities, in `SSL/account.json`: one for each directory."""

from __future__ import annotations

import json
from contextlib import suppress
from typing import Any

from hippodrome.control.certificates.rules import ACCOUNT
from hippodrome.control.ports import Conflict, Documents

MAX_TRIES = 10  # for a conditional write that other runs may make at the same time


def account_key(documents: Documents, directory: str) -> dict[str, Any]:
    """Return the key of our account at this directory (JWK). A new key is stored before it is used.

    Raises Conflict after `MAX_TRIES`.
    """
    from hippodrome.control.certificates.session import new_account_key  # noqa: PLC0415 - its import is slow

    for _ in range(MAX_TRIES):
        document = documents.get(ACCOUNT)
        keys: dict[str, dict[str, Any]] = json.loads(document.body) if document else {}
        if directory in keys:
            return keys[directory]
        body = json.dumps({**keys, directory: new_account_key()}, indent=1).encode()
        with suppress(Conflict):  # another run has written it; it is read again in any case
            documents.replace(ACCOUNT, body, document.etag) if document else documents.create(ACCOUNT, body)
    raise Conflict(ACCOUNT)
