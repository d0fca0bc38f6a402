"""Checks the bucket, the queues, the alarms, and who gets the alarms' mails."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.operate import snapshot
from hippodrome.deployment.operate.doctor.check_context import CheckContext

APPLY = "Run `hippodrome deploy`: it puts this right."


def bucket(context: CheckContext) -> Iterator[Finding]:
    """Check whether the bucket belongs to this account, is closed to the public, keeps versions, and requires TLS."""
    name, client = context.installation["Bucket"], context.account.client("s3")
    try:
        client.head_bucket(Bucket=name, ExpectedBucketOwner=context.account.id)
    except ClientError as error:
        status = errors.status(error)
        if status == 404:
            yield bad("bucket", f"{name} is gone, and the data with it.", "See the S3 console; older copies may exist.")
        elif status == 403:
            text = f"{name} may not be looked at, or belongs to another account."
            yield bad("bucket", text, "Check the credentials.")
        else:
            raise
        return
    block = _unless("NoSuchPublicAccessBlockConfiguration", lambda: client.get_public_access_block(Bucket=name))
    settings = ("BlockPublicAcls", "IgnorePublicAcls", "BlockPublicPolicy", "RestrictPublicBuckets")
    off = [setting for setting in settings if not block.get("PublicAccessBlockConfiguration", {}).get(setting)]
    versioned = client.get_bucket_versioning(Bucket=name).get("Status") == "Enabled"
    policy = _unless("NoSuchBucketPolicy", lambda: client.get_bucket_policy(Bucket=name)).get("Policy", "{}")
    only_tls = any(map(_denies_without_tls, json.loads(policy).get("Statement", [])))
    if off:
        yield bad("bucket", f"Public access to {name} is not blocked ({', '.join(off)}).", APPLY)
    if not versioned:
        yield look("bucket", f"{name} keeps no older versions: what is deleted is gone.", APPLY)
    if not only_tls:
        yield bad("bucket", f"{name} can be read without TLS.", APPLY)
    if not off and versioned and only_tls:
        yield good("bucket", f"{name}: private, versioned, TLS only.")


def _unless(code: str, ask: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return AWS's answer; {} if it is this error."""
    try:
        return ask()
    except ClientError as error:
        if errors.code(error) != code:
            raise
        return {}


def _denies_without_tls(statement: dict[str, Any]) -> bool:
    condition = json.dumps(statement.get("Condition", {})).lower().replace(" ", "")
    return statement.get("Effect") == "Deny" and '"aws:securetransport":"false"' in condition


def queues(context: CheckContext) -> Iterator[Finding]:
    """Check whether the dead-letter queues are empty, and count the messages that wait."""
    queues = snapshot.queues(context.account, context.installation.stack)
    dead = [queue for queue in queues if queue.dead]
    if not dead:
        yield look("queues", "The stack has no dead-letter queues.", APPLY)
        return
    full = [f"{queue.name} {queue.waiting:,}" for queue in dead if queue.waiting]
    if full:
        yield bad(
            "queues",
            f"Messages that could not be dealt with: {', '.join(full)}.",
            "`hippodrome logs --all --errors` says why; SQS's console can send them again (redrive).",
        )
    else:
        waiting = sum(queue.waiting for queue in queues)
        yield good("queues", f"No dead letters; {waiting:,} messages wait.")


def alarms(context: CheckContext) -> Iterator[Finding]:
    """Check whether an alarm fires."""
    all_alarms = [*snapshot.alarms(context.account, context.installation)]
    firing = sorted(alarm["AlarmName"] for alarm in all_alarms if alarm.get("StateValue") == "ALARM")
    if not all_alarms:
        yield look("alarms", "The stack has no alarms.", APPLY)
    elif firing:
        yield bad(
            "alarms",
            f"Firing: {', '.join(firing)}.",
            f"See {context.installation.outputs.get('Dashboard', 'the dashboard')}.",
        )
    else:
        yield good("alarms", f"{len(all_alarms)} alarms, none fires.")


def listeners(context: CheckContext) -> Iterator[Finding]:
    """Check whether the alarms' topic has a confirmed subscription."""
    subscriptions = {
        line["Endpoint"]: line["SubscriptionArn"]
        for line in snapshot.subscriptions(context.account, context.installation)
    }
    pending = [address for address, arn in subscriptions.items() if arn == "PendingConfirmation"]
    confirmed = [address for address, arn in subscriptions.items() if arn.startswith("arn:")]
    if pending:
        yield look("alarm e-mail", f"{', '.join(pending)} has not confirmed.", "Follow the link in AWS's e-mail.")
    if confirmed:
        yield good("alarm e-mail", f"Alarms go to {', '.join(confirmed)}.")
    elif not pending:
        yield look("alarm e-mail", "The alarms have no subscriber.", "Give `hippodrome deploy --no-study` an --email.")
