"""The code bucket, made before the stack, with the functions' zips and the templates: private and encrypted."""

from __future__ import annotations

import base64
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.deployment.code.build import Function
from hippodrome.deployment.stack.inventory import bucket_exists

_AT_ONCE = 4
PAUSE = 10  # seconds between two tries to make the bucket
MAX_DELETION = 600
"""The most seconds to wait while CreateBucket answers OperationAborted, since S3 deletes a bucket of that name: this
takes minutes, in rare cases up to an hour (aws/aws-cli issues 2411 and 2593)."""
SETTLING = 180
"""The most seconds to wait while a new bucket answers OperationAborted to changes of its settings, although no other
is under way: mostly less than a minute (hashicorp/terraform-provider-aws issue 7628, ansible/ansible pull request
66778)."""
SETTLING_PAUSE = 5  # seconds


class CodeBucket:
    """The code bucket of a stack. Every request names the account that must own it, so no other bucket is written."""

    def __init__(self, account: Account, stack: str) -> None:
        self._account = account
        self._stack = stack
        self.name = resource_names.code_bucket(stack, account.id, account.region)
        self._s3 = account.client("s3")
        self._owner = {"Bucket": self.name, "ExpectedBucketOwner": account.id}

    def exists(self) -> bool:
        """Whether the bucket exists. Raises `Problem` if it belongs to another account."""
        try:
            return bucket_exists(self._account, self.name)
        except ClientError as error:
            if errors.status(error) == 403:
                raise self._not_ours() from None
            raise

    def make(self) -> bool:
        """Make the bucket, or finish what a run has begun. Return whether anything was done. The tag is set last."""
        exists = self.exists()
        if exists and self._tagged():
            return False
        if not exists:
            self._create()
        block = {"BlockPublicAcls": True, "IgnorePublicAcls": True}
        block |= {"BlockPublicPolicy": True, "RestrictPublicBuckets": True}
        self._set(self._s3.put_public_access_block, PublicAccessBlockConfiguration=block)
        rule = {"ApplyServerSideEncryptionByDefault": {"SSEAlgorithm": "AES256"}}
        self._set(self._s3.put_bucket_encryption, ServerSideEncryptionConfiguration={"Rules": [rule]})
        self._set(self._s3.put_bucket_policy, Policy=json.dumps(self._tls_only()))
        unfinished = {
            "ID": "unfinished uploads",
            "Status": "Enabled",
            "Filter": {"Prefix": ""},
            "AbortIncompleteMultipartUpload": {"DaysAfterInitiation": 1},
        }
        self._set(self._s3.put_bucket_lifecycle_configuration, LifecycleConfiguration={"Rules": [unfinished]})
        tags = [{"Key": TAG, "Value": self._stack}]
        self._set(self._s3.put_bucket_tagging, Tagging={"TagSet": tags})
        return True

    def upload(self, functions: Sequence[Function]) -> int:
        """Upload the zips that the bucket does not have, and return how many."""
        with ThreadPoolExecutor(_AT_ONCE) as pool:
            present = list(pool.map(lambda function: self._has(function.key), functions))
        missing = [function for function, is_present in zip(functions, present, strict=True) if not is_present]
        if not missing:
            return 0
        with screen.ProgressBars() as bar:
            task = bar.add_task("Uploading functions", total=len(missing))
            for function in missing:
                bar.update(task, description=f"Uploading {function.name}")
                self.put(function.key, function.pack())
                bar.advance(task)
        return len(missing)

    def put(self, key: str, body: bytes) -> str:
        """Store an object, let S3 check its sha256, and return its URL."""
        checksum = base64.b64encode(hashlib.sha256(body).digest()).decode()
        self._s3.put_object(**self._owner, Key=key, Body=body, ChecksumSHA256=checksum)
        return self.url(key)

    def get(self, key: str) -> bytes:
        """Read an object's content; empty if there is no object or no bucket."""
        try:
            answer = self._s3.get_object(**self._owner, Key=key)
        except ClientError as error:
            if errors.status(error) == 404:
                return b""
            raise
        return bytes(answer["Body"].read())

    def put_template(self, text: str) -> str:
        """Store a template under its hash, unless the bucket has it, and return its URL for CloudFormation."""
        body = text.encode()
        key = f"templates/{hashlib.sha256(body).hexdigest()[:16]}.yml"
        return self.url(key) if self._has(key) else self.put(key, body)

    def url(self, key: str) -> str:
        """Return the URL of an object, in the form that CloudFormation takes."""
        return f"{self._s3.meta.endpoint_url.rstrip('/')}/{self.name}/{key}"

    def _has(self, key: str) -> bool:
        try:
            answer = self._s3.head_object(**self._owner, Key=key)
        except ClientError as error:
            if errors.status(error) == 404:
                return False
            raise
        return int(answer["ContentLength"]) > 0

    def _tagged(self) -> bool:
        try:
            tags = self._s3.get_bucket_tagging(**self._owner)["TagSet"]
        except ClientError as error:
            if errors.code(error) in {"NoSuchTagSet", "NoSuchTagSetError"}:
                return False
            raise
        return any(tag["Key"] == TAG and tag["Value"] == self._stack for tag in tags)

    def _create(self) -> None:
        place: dict[str, Any] = {}
        if self._account.region != "us-east-1":  # S3 refuses us-east-1 as a LocationConstraint
            place = {"CreateBucketConfiguration": {"LocationConstraint": self._account.region}}
        for waited in range(0, MAX_DELETION, PAUSE):
            try:
                self._s3.create_bucket(Bucket=self.name, ObjectOwnership="BucketOwnerEnforced", **place)
                break
            except ClientError as error:
                code = errors.code(error)
                if code == "BucketAlreadyExists":
                    raise self._not_ours() from None
                if code == "BucketAlreadyOwnedByYou":
                    break
                if code != "OperationAborted":
                    raise
            if not waited:
                screen.info(f"S3 is still deleting the bucket {self.name} of an earlier stack: waiting for that …")
            time.sleep(PAUSE)
        else:
            raise Problem(
                f"S3 is still deleting the bucket {self.name} of an earlier stack.", "Run the same command later."
            )
        self._s3.get_waiter("bucket_exists").wait(**self._owner, WaiterConfig={"Delay": 1, "MaxAttempts": 30})

    def _set(self, call: Callable[..., Any], **setting: Any) -> None:
        """Set a property of the bucket. Try again while S3 answers OperationAborted.

        Raises `Problem` after `SETTLING`.
        """
        for waited in range(0, SETTLING, SETTLING_PAUSE):
            try:
                call(**self._owner, **setting)
                return
            except ClientError as error:
                if errors.code(error) != "OperationAborted":
                    raise
            if not waited:
                screen.info(f"S3 is still at work on the new bucket {self.name}: waiting for that …")
            time.sleep(SETTLING_PAUSE)
        raise Problem(f"S3 is still at work on the new bucket {self.name}.", "Run the same command again in a while.")

    def _not_ours(self) -> Problem:
        return Problem(
            f"The bucket {self.name} belongs to another account, or these credentials may not see it.",
            "Take another name for the stack with --stack, or ask the administrator for s3:ListBucket on it.",
        )

    def _tls_only(self) -> dict[str, Any]:
        arn = f"arn:{self._account.identity['Arn'].split(':')[1]}:s3:::{self.name}"
        statement = {
            "Sid": "TlsOnly",
            "Effect": "Deny",
            "Principal": "*",
            "Action": "s3:*",
            "Resource": [arn, f"{arn}/*"],
            "Condition": {"Bool": {"aws:SecureTransport": "false"}},
        }
        return {"Version": "2012-10-17", "Statement": [statement]}
