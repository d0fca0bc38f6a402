"""The names of an installation's resources on AWS, as far as they contain the stack's name.

`infra/template.yml` builds the same names. The names of servers' resources are in `hippodrome.control.model.ids`.
"""

from __future__ import annotations

import re

STACK = "hippodrome"
STACK_NAME = re.compile(r"[A-Za-z]([A-Za-z0-9-]{0,28}[A-Za-z0-9])?")
"""The form of a stack's name. It has at most 30 characters: `<stack>-code-<account>-<region>` is a bucket's name,
which may have 63."""
RESERVED_STACK_NAME = re.compile(r"default|(xn--|sthree-|amzn-s3-demo-).*", re.IGNORECASE)
"""Names that no stack may have: an account has a schedule group and maybe a cluster `default`, and S3 refuses the
other prefixes.

(EventBridge Scheduler's CreateScheduleGroup; ECS's CreateCluster; S3's "Bucket naming rules".)
"""

TAG = "hippodrome:stack"  # the tag that resources of a stack carry, with its name as the value
API = "api"  # the source of the site's access log

_OURS = "/hippodrome/{}/"
_VENDED = "/aws/vendedlogs/hippodrome/{}/"
"""The prefix of log groups that a service of AWS writes to. It needs no entry for them in a resource policy."""


def prefix(stack: str) -> str:
    """Return the prefix of the stack's task definitions, functions and queues. Another stack's may begin with it."""
    return f"{stack}-"


def function(stack: str, name: str) -> str:
    """Return the name of the function that runs the handler `name` in `lambdas/`."""
    return f"{stack}-{name}"


def family(stack: str, project_id: str) -> str:
    """Return the name of a project's task definition family, which all its revisions share."""
    return f"{stack}-{project_id}"


def bucket_prefix(stack: str) -> str:
    """Return the prefix of the names of the stack's buckets."""
    return prefix(stack).lower()


def code_bucket(stack: str, account_id: str, region: str) -> str:
    """Return the name of the bucket for the zips of the stack's functions and for its templates."""
    return f"{stack}-code-{account_id}-{region}".lower()


def code_bucket_region(stack: str, bucket: str) -> str | None:
    """Return the region of a bucket of that name; None if it is not the code bucket of a stack of that name."""
    match = re.fullmatch(rf"{re.escape(stack.lower())}-code-\d{{12}}-(.+)", bucket)
    return match[1] if match else None


def secret(stack: str, name: str) -> str:
    """Return the name of the parameter of Systems Manager that holds the secret `name`."""
    return f"/hippodrome/{stack}/{name}"


def log_prefixes(stack: str) -> tuple[str, ...]:
    """Return the prefixes of the names of the stack's log groups."""
    return _OURS.format(stack), _VENDED.format(stack)


def log_group(stack: str, source: str) -> str:
    """Return the name of the log group of a source, which is a function's name, `trial`, `image` or `api`."""
    return (_VENDED if source == API else _OURS).format(stack) + source


def log_source(stack: str, group: str) -> str:
    """Return the source of the log group of this name: a function's name, `trial`, `image` or `api`."""
    return group.removeprefix(_OURS.format(stack)).removeprefix(_VENDED.format(stack))
