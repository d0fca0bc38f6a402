"""Removes what keeps IAM from deleting an installation's managed policy and its roles.

IAM deletes no managed policy that is attached to a user, group or role, or that has other versions than its default
(API reference, DeletePolicy; DeleteConflict otherwise). It deletes no role that has policies (DeleteRole).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account

_MISSING = "NoSuchEntity"


class PolicyAttachments(NamedTuple):
    """A managed policy, and the users, groups and roles to which it is attached."""

    name: str
    users: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    roles: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return bool(self.users or self.groups or self.roles)

    @property
    def whom(self) -> str:
        """The users, groups and roles, in words: `the user ada, the group lab`."""
        kinds = (("user", self.users), ("group", self.groups), ("role", self.roles))
        return ", ".join(f"the {kind} {name}" for kind, names in kinds for name in names)


def attached(account: Account, arn: str, usage: str = "PermissionsPolicy") -> PolicyAttachments:
    """Ask IAM who has the policy; with `usage` PermissionsBoundary, whose boundary it is. Empty if it is gone."""
    by_kind: dict[str, list[str]] = {"User": [], "Group": [], "Role": []}
    pages = account.client("iam").get_paginator("list_entities_for_policy")
    try:
        for page in pages.paginate(PolicyArn=arn, PolicyUsageFilter=usage):
            for kind, names in by_kind.items():
                names += [principal[f"{kind}Name"] for principal in page.get(f"Policy{kind}s", ())]
    except ClientError as error:
        if errors.code(error) != _MISSING:
            raise
    return PolicyAttachments(arn.rsplit("/", 1)[-1], *(tuple(dict.fromkeys(names)) for names in by_kind.values()))


def must_be_no_boundary(account: Account, arn: str) -> None:
    """Raise `Problem` if the policy is a permissions boundary: without it, its user or role could do more."""
    listed = attached(account, arn, "PermissionsBoundary")
    iam = account.client("iam")
    users = [user for user in listed.users if _bound(iam.get_user(UserName=user)["User"], arn)]
    roles = [role for role in listed.roles if _bound(iam.get_role(RoleName=role)["Role"], arn)]
    if users or roles:
        bound = PolicyAttachments(listed.name, tuple(users), (), tuple(roles))
        raise Problem(
            f"The policy {bound.name} is the permissions boundary of {bound.whom}.",
            "Give them another boundary, or remove them; then run the same command again.",
        )


def _bound(entity: Mapping[str, Any], arn: str) -> bool:
    return bool(entity.get("PermissionsBoundary", {}).get("PermissionsBoundaryArn") == arn)


def detach(account: Account, arn: str) -> PolicyAttachments:
    """Detach the policy, delete its other versions, and return who had it. Raises `Problem` if it is a boundary."""
    must_be_no_boundary(account, arn)
    by_kind = attached(account, arn)
    iam = account.client("iam")
    for name in by_kind.users:
        _quietly(iam.detach_user_policy, UserName=name, PolicyArn=arn)
    for name in by_kind.groups:
        _quietly(iam.detach_group_policy, GroupName=name, PolicyArn=arn)
    for name in by_kind.roles:
        _quietly(iam.detach_role_policy, RoleName=name, PolicyArn=arn)
    for version in _other_versions(iam, arn):
        _quietly(iam.delete_policy_version, PolicyArn=arn, VersionId=version)
    return by_kind


def free_role(account: Account, name: str) -> None:
    """Detach all managed policies of a role, and delete its inline policies; people may have added such policies."""
    iam = account.client("iam")
    try:
        policies = [
            attached_policy["PolicyArn"]
            for page in iam.get_paginator("list_attached_role_policies").paginate(RoleName=name)
            for attached_policy in page["AttachedPolicies"]
        ]
        own = [
            policy_name
            for page in iam.get_paginator("list_role_policies").paginate(RoleName=name)
            for policy_name in page["PolicyNames"]
        ]
    except ClientError as error:
        if errors.code(error) == _MISSING:
            return
        raise
    for arn in policies:
        _quietly(iam.detach_role_policy, RoleName=name, PolicyArn=arn)
    for policy in own:
        _quietly(iam.delete_role_policy, RoleName=name, PolicyName=policy)


def _other_versions(iam: Any, arn: str) -> Iterator[str]:
    try:
        for page in iam.get_paginator("list_policy_versions").paginate(PolicyArn=arn):
            yield from (version["VersionId"] for version in page["Versions"] if not version["IsDefaultVersion"])
    except ClientError as error:
        if errors.code(error) != _MISSING:
            raise


def _quietly(call: Any, **arguments: Any) -> None:
    """Make the call, and ignore an error that says that the entity is gone already."""
    try:
        call(**arguments)
    except ClientError as error:
        if errors.code(error) != _MISSING:
            raise
