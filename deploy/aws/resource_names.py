"""The names of an installation's resources on AWS: everything that is named after the stack is named here.

What CloudFormation names, `infra/template.yml` names alike; the names of servers' resources are in
`hippodrome.model.ids`.
"""

from __future__ import annotations

import re

TAG = "hippodrome:stack"  # the tag that resources of a stack carry, with its name as the value
API = "api"  # the source of the site's access log

_OURS = "/hippodrome/{}/"
_VENDED = "/aws/vendedlogs/hippodrome/{}/"
"""Where a service of AWS writes, by a policy that names no group of this prefix."""


def prefix(stack: str) -> str:
    """What the names of its task definitions, functions and queues begin with; those of other stacks may, too."""
    return f"{stack}-"


def function(stack: str, name: str) -> str:
    """The function that runs the handler `name` in `lambdas/`."""
    return f"{stack}-{name}"


def family(stack: str, project_id: str) -> str:
    """The task definition of a project: what all its revisions share."""
    return f"{stack}-{project_id}"


def bucket_prefix(stack: str) -> str:
    """What the names of its buckets begin with."""
    return prefix(stack).lower()


def code_bucket(stack: str, account_id: str, region: str) -> str:
    """The bucket where its functions' zips and templates lie."""
    return f"{stack}-code-{account_id}-{region}".lower()


def code_bucket_region(stack: str, bucket: str) -> str | None:
    """The region of a bucket of that name; None if it is not the code bucket of a stack of that name."""
    found = re.fullmatch(rf"{re.escape(stack.lower())}-code-\d{{12}}-(.+)", bucket)
    return found[1] if found else None


def log_prefixes(stack: str) -> tuple[str, ...]:
    """What the names of all its log groups begin with."""
    return _OURS.format(stack), _VENDED.format(stack)


def log_group(stack: str, source: str) -> str:
    """The log group of a source: a function's name, `trial`, `image` or `api`."""
    return (_VENDED if source == API else _OURS).format(stack) + source


def log_source(stack: str, group: str) -> str:
    """The source of a log group by its name."""
    return group.removeprefix(_OURS.format(stack)).removeprefix(_VENDED.format(stack))
