"""Opens a data bucket that `destroy` has kept: participants' data stay in it, and no stack names it any more."""

from __future__ import annotations

import re
from collections.abc import Iterator

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.control.model import ids
from hippodrome.control.model.project import MASTER_LIST
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.stack import inventory
from hippodrome.export import keys
from hippodrome.export.bucket import Bucket

_NAME = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")  # no ARN: that would hide the owner
_WHICH = "`hippodrome destroy --dry-run` names the buckets that it has kept (with --stack and --region)."


def open_bucket(account: Account, name: str, project: str) -> Bucket:
    """Open a bucket that `destroy` has kept. If the list of projects is missing in it, this only warns.

    Raises `Problem` if the bucket is not the account's own, or holds no data of this project's participants.
    """
    _must_be_ours(account, name)
    source, present = Bucket(account.client("s3"), name, account.id), projects(account, name)
    listed = _holds(account, name, MASTER_LIST)
    if not present and not listed:
        raise Problem(
            f"The bucket {name} holds no installation's data: neither {MASTER_LIST} nor participants' answers.", _WHICH
        )
    if project not in present:
        raise Problem(
            f"The bucket {name} holds nothing of participants of {project}.",
            f"It holds those of {', '.join(present)}: name one of them."
            if present
            else "It holds no participant's data at all: check the bucket's name.",
        )
    if not listed:
        screen.warning(
            f"{MASTER_LIST} is gone from {name}: steps stand in the order of their names, and who has finished is "
            "not known."
        )
    return source


def projects(account: Account, name: str) -> list[str]:
    """Return the projects, registered or not, that have documents of participants in this bucket."""
    return [project for project in _folders(account, name) if _holds(account, name, keys.prefix(project))]


def _folders(account: Account, name: str) -> Iterator[str]:
    pages = account.client("s3").get_paginator("list_objects_v2")
    for page in pages.paginate(Bucket=name, ExpectedBucketOwner=account.id, Delimiter="/"):
        for line in page.get("CommonPrefixes", ()):
            if ids.is_project_id(folder := line["Prefix"].removesuffix("/")):
                yield folder


def _holds(account: Account, name: str, prefix: str) -> bool:
    owned = {"Bucket": name, "ExpectedBucketOwner": account.id}
    return bool(account.client("s3").list_objects_v2(Prefix=prefix, MaxKeys=1, **owned).get("Contents"))


def _must_be_ours(account: Account, name: str) -> None:
    if not _NAME.fullmatch(name):
        raise Problem(f"{name!r} is no bucket's name.", "Give its name alone, without s3:// and without a path.")
    owner = account.id  # asked first: S3's 403 does not say whether the credentials have expired
    try:
        exists = inventory.bucket_exists(account, name)
    except ClientError as error:
        if errors.status(error) != 403:
            raise
        raise Problem(
            f"The bucket {name} does not belong to the account {owner}, or these credentials may not look at it.",
            "Check its name and --profile. The policy for researchers goes with the stack: an administrator's "
            "credentials can.",
        ) from None
    if not exists:
        raise Problem(f"There is no bucket {name}.", _WHICH)
