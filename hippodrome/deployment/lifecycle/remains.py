"""After `destroy`: lists what AWS still has of the installation: what should be gone, and what stays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hippodrome.console import screen
from hippodrome.console.formatting import count, duration, size
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.cost.prices import S3_GB_MONTH
from hippodrome.deployment.lifecycle.removal import FoundInstallation, Removal
from hippodrome.deployment.stack import acm_records, inventory, retained_bucket
from hippodrome.deployment.stack.acm_records import Validation
from hippodrome.deployment.stack.inventory import ListedResource
from hippodrome.deployment.stack.listings import LISTINGS

LISTED = 180
"""The seconds for which AWS may still list deleted resources: a queue for up to 60 (SQS API reference, DeleteQueue), a
schedule group until its schedules are deleted (EventBridge Scheduler user guide), buckets and event source mappings
for a while."""
PAUSE = 20  # seconds between two looks
OLD_VERSIONS = 30  # days that the data bucket keeps versions that are not current (the template's lifecycle rule)


def look_again(removal: Removal, remembered: Sequence[inventory.Resource]) -> Remains:
    """List what exists after a removal. Waits up to `LISTED` seconds while AWS still lists deleted resources.

    `remembered` are the resources that CloudFormation listed before the removal.
    """

    def look() -> Remains:
        after = removal.look()
        things = inventory.still_there(removal.account, remembered)
        things += [*after.things, *inventory.tagged(removal.account, removal.name)]
        remaining = [thing for thing in dict.fromkeys(things) if thing.name not in after.data]
        return Remains(removal, remembered, after, remaining)

    title = f"AWS still lists what is deleted: up to {duration(LISTED)}"
    return removal.executor.wait(look, LISTED, pause=PAUSE, title=title)


@dataclass
class Remains:
    """The results of the last listing. The resources in `left` should be gone; all others stay on purpose."""

    removal: Removal
    remembered: Sequence[inventory.Resource]
    after: FoundInstallation
    left: Sequence[ListedResource]

    def __bool__(self) -> bool:
        return bool(self.left)

    @property
    def _account(self) -> Account:
        return self.removal.account

    @cached_property
    def stored(self) -> Mapping[str, int]:
        """By data bucket that stays, its size in bytes."""
        return {bucket: inventory.stored(self._account, bucket) for bucket in self.after.data}

    @cached_property
    def service_roles(self) -> Sequence[str]:
        """The names of the roles that AWS has made for the whole account."""
        return inventory.service_roles(self._account)

    @cached_property
    def server_names(self) -> Sequence[str]:
        """DNS names of servers, of this or another installation of the same domain; empty while the stack exists."""
        where = [] if self.after.stack else self.after.addresses
        return [name for place in where for name in inventory.server_names(self._account, place)]

    @cached_property
    def records(self) -> Sequence[tuple[Validation, str, str]]:
        """The validation records that stay, each with the reason and the command that deletes it."""
        kept_records = [(record, f"it renews {users} as well") for record, users in self.removal.kept]
        kept_before = {record for record, _ in kept_records}
        for addresses in self.after.addresses if not self.after.stack else ():
            for one in acm_records.of_domain(self._account, addresses.zone, addresses.site):
                if one not in kept_before:
                    users = acm_records.users(self._account, one)
                    why = f"it renews {', '.join(users)}" if users else "it may prove the name for another AWS account"
                    kept_records.append((one, why))
        return [
            (one, why, acm_records.removal(one.zone, record))
            for one, why in kept_records
            if (record := acm_records.present(self._account, one))
        ]

    def as_json(self) -> dict[str, Any]:
        """Return what is left and what is kept as JSON data, for scripts."""
        return {
            "left": [
                {
                    "kind": thing.kind,
                    "name": thing.name,
                    "month": inventory.cost_of(thing.kind),
                    "remove": inventory.removal_of(thing, self._account),
                }
                for thing in self.left
            ],
            "kept": list(self.after.data),
            "storedBytes": self.stored,
            "records": [{"name": record.name, "why": why, "remove": remove} for record, why, remove in self.records],
            "roles": self.service_roles,
            "serverNames": self.server_names,
            "errors": self.removal.errors,
        }

    def show(self) -> None:
        """Print a table of what is left or kept. Kinds of which nothing is left are only counted."""
        rows = [*self._rows()]
        if rows:
            screen.table(["what", "left", "a month", ""], rows)
        kinds = {LISTINGS[thing.type].kind for thing in self.remembered if thing.type in LISTINGS}
        removed_kinds = kinds - {thing.kind for thing in self.left}
        if removed_kinds:
            number = count(len(removed_kinds), "other kind" if rows else "kind")
            screen.result(f"{number} of things looked at: nothing left.")

    def _rows(self) -> Iterator[tuple[str, str, str, str]]:
        for kind in sorted({thing.kind for thing in self.left}):
            names = [thing.name for thing in self.left if thing.kind == kind]
            yield kind, str(len(names)), inventory.cost_of(kind), ", ".join(names[:3])
        for bucket, stored in self.stored.items():
            month = f"${stored / 1e9 * S3_GB_MONTH:,.2f} ({size(stored)})"
            yield "participants' data", "kept", month, bucket
        for one, _, _ in self.records:
            yield "DNS record", "kept", "nothing", one.name
        for name in self.server_names[:10]:
            yield "server's name", "kept", "nothing", name
        for role in self.service_roles:
            yield "AWS's own role", "kept", "nothing", role

    def conclude(self, place: str) -> int:
        """Print what stays, and how to fetch or delete it; return the exit code. Raises `Problem` if something is left.

        `place` are the options with which other commands find this account and region.
        """
        account, name = self._account, self.removal.name
        for record, why, remove in self.records:
            screen.warning(f"The DNS record {record.name} stays: {why}. To delete it:")
            screen.info(f"  {remove}")
        if self.left:
            raise self._problem()
        if self.server_names:
            screen.warning(
                f"{count(len(self.server_names), 'name')} of servers are in the zone: another installation's with the "
                "same domain, or left over. If there is no other, delete them in Route 53: AWS may have given their "
                "addresses to others."
            )
        for role in self.service_roles:
            screen.info(f"The role {role} is the whole account's. If nothing else in it needs that:")
            screen.info(f"  aws iam delete-service-linked-role --role-name {role}")
        other = " else" if self.after.data or self.records or self.server_names or self.service_roles else ""
        screen.success(f"Nothing{other} is left of {name} in {account.region}.")
        for bucket in self.after.data:
            _tell_kept(account, bucket, place)
        if self.after.data:
            screen.info("To delete what stays:")
            screen.info(f"  hippodrome destroy --stack {name} --data {place}")
        return Exit.DONE

    def _problem(self) -> Problem:
        details: list[str] = []
        for thing in self.left:
            details.append(f"{thing.kind}: {thing.name} (a month: {inventory.cost_of(thing.kind)})")
            details += [f"  {removal}"] if (removal := inventory.removal_of(thing, self._account)) else []
        return Problem(
            f"{count(len(self.left), 'thing')} {'is' if len(self.left) == 1 else 'are'} left.",
            "Run the same command again; what it leaves then, the commands above remove.",
            [*details, *self.removal.errors],
        )


def _tell_kept(account: Account, bucket: str, place: str) -> None:
    """Print how to fetch the data in a kept bucket."""
    projects = retained_bucket.projects(account, bucket)
    if not projects:
        sentences = (
            "The participants' data in it have been deleted; S3 keeps their older versions for about "
            f"{OLD_VERSIONS} days."
            if retained_bucket.older_versions(account, bucket)
            else "There are no participants' data in it."
        )
        screen.info(f"The bucket {bucket} stays. {sentences}")
        return
    screen.info(f"The participants' data stay in the bucket {bucket}. To fetch them:")
    for project in projects:
        screen.info(f"  hippodrome data {project} --bucket {bucket} {place}")
