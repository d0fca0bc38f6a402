"""What an administrator may decide about an installation: options of the commands, parameters of the template."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import typer

from deploy.account import Account
from deploy.problem import Problem
from deploy.zone import clean_domain, find_zone, read_zone

Domain = Annotated[
    str | None,
    typer.Option("--domain", help="The domain below which servers get names; its zone is in Route 53. Needed once."),
]
Site = Annotated[
    str | None, typer.Option("--site", help="First part of the address that participants open; `study` if never given.")
]
Zone = Annotated[
    str | None, typer.Option("--zone", help="The hosted zone's id, if the domain alone does not tell which.")
]
Email = Annotated[str | None, typer.Option("--email", help="Where alarms go; '' for nowhere.")]
MaxRuntime = Annotated[
    int | None, typer.Option("--max-runtime", min=5, max=1440, help="Minutes after which any server is stopped.")
]
Budget = Annotated[
    int | None, typer.Option("--budget", min=0, help="US dollars a month of the account before a warning; 0: none.")
]
Vpc = Annotated[str | None, typer.Option("--vpc", help="A VPC of yours for the servers; '' for one of their own.")]
Subnets = Annotated[str | None, typer.Option("--subnets", help="Public subnets of that VPC, separated by commas.")]
LogDays = Annotated[
    int | None, typer.Option("--log-days", help="Days that logs are kept: 1, 3, 5, 7, 14, 30, 60, 90 …")
]
Rate = Annotated[
    int | None, typer.Option("--rate", min=10, max=10000, help="HTTP requests a second that the site answers.")
]
ServerNames = Annotated[
    str | None,
    typer.Option("--server-names", help="`hash`, or `userId` to let projects name servers after participants' ids."),
]

_PARAMETERS = {  # the template's parameter for each setting that goes there as it is
    "site": "SiteHost",
    "email": "AlarmEmail",
    "max_runtime": "MaxRuntime",
    "budget": "MonthlyBudget",
    "vpc": "VpcId",
    "subnets": "SubnetIds",
    "log_days": "LogRetentionDays",
    "rate": "RequestsPerSecond",
    "server_names": "ServerNames",
}


@dataclass(frozen=True)
class Settings:
    """What was asked for; None means: as it was, or as the template has it."""

    domain: str | None = None
    site: str | None = None
    zone: str | None = None
    email: str | None = None
    max_runtime: int | None = None
    budget: int | None = None
    vpc: str | None = None
    subnets: str | None = None
    log_days: int | None = None
    rate: int | None = None
    server_names: str | None = None

    def parameters(
        self, account: Account, defaults: Mapping[str, str | None], previous: Mapping[str, str], code_bucket: str
    ) -> dict[str, str]:
        """The template's parameters: what was asked for, else what it was, else the default. Raises `Problem`."""
        found = {name: value for name, value in defaults.items() if value is not None}
        found |= {name: value for name, value in previous.items() if name in defaults}
        for setting, parameter in _PARAMETERS.items():
            value = getattr(self, setting)
            if value is not None:
                if parameter not in defaults:
                    raise Problem(f"The template has no parameter {parameter} for --{setting.replace('_', '-')}.")
                found[parameter] = str(value).strip()
        found["SubnetIds"] = ",".join(part.strip() for part in found.get("SubnetIds", "").split(",") if part.strip())
        if bool(found.get("VpcId")) != bool(found["SubnetIds"]):
            raise Problem(
                "--vpc and --subnets go together.", "Give both, or both as '' for a VPC of the installation's."
            )
        found |= self._addresses(account, previous) | {"CodeBucket": code_bucket}
        missing = sorted(set(defaults) - set(found))
        if missing:
            raise Problem(f"The template wants values that no option gives: {', '.join(missing)}.")
        return {name: value for name, value in found.items() if name in defaults}

    def _addresses(self, account: Account, previous: Mapping[str, str]) -> dict[str, str]:
        before = previous.get("RootDomain", "")
        domain = clean_domain(self.domain) if self.domain else before
        if not domain:
            raise Problem(
                "Which domain? The first time it has to be told.",
                "Such as --domain example.org (with make: DOMAIN=example.org). Its zone has to be in Route 53.",
            )
        if self.zone:
            zone = read_zone(account, self.zone)
            if domain != zone.domain and not domain.endswith(f".{zone.domain}"):
                raise Problem(f"The hosted zone {self.zone} is of {zone.domain}, which {domain} is not below.")
            return {"RootDomain": domain, "HostedZoneId": zone.id}
        if domain == before and previous.get("HostedZoneId"):
            return {"RootDomain": domain, "HostedZoneId": previous["HostedZoneId"]}
        return {"RootDomain": domain, "HostedZoneId": find_zone(account, domain).id}
