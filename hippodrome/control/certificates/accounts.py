"""The keys of our accounts at ACME certificate authorities, in `SSL/account.json`: one for each directory."""

from __future__ import annotations

import json
from typing import Any

from hippodrome.control.certificates.rules import ACCOUNT
from hippodrome.control.ports import Conflict, Documents

MAX_TRIES = 10  # for a conditional write that other runs may make at the same time


def account_key(documents: Documents, directory: str) -> dict[str, Any]:
    """Return the key of our account at this directory (JWK). A new key is stored before it is used.

    Raises ValueError if the document is no JSON object, and Conflict after `MAX_TRIES`.
    """
    from hippodrome.control.certificates.session import new_account_key  # noqa: PLC0415 - its import is slow

    for _ in range(MAX_TRIES):
        document = documents.get(ACCOUNT)
        keys = json.loads(document.body) if document else {}
        if not isinstance(keys, dict):
            raise ValueError(f"{ACCOUNT} is not a JSON object")
        if directory in keys:
            key: dict[str, Any] = keys[directory]
            return key
        keys[directory] = new_account_key()
        body = json.dumps(keys, indent=1).encode()
        try:
            if document:
                documents.replace(ACCOUNT, body, document.etag)
            else:
                documents.create(ACCOUNT, body)
        except Conflict:
            continue
        created: dict[str, Any] = keys[directory]
        return created
    raise Conflict(ACCOUNT)
