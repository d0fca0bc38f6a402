"""The settings of an installation: the administrator's options, which become parameters of the template."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any, get_type_hints

from typer import Option

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws import availability_zones, concurrency
from hippodrome.deployment.aws.account import Account, site_host
from hippodrome.deployment.aws.hosted_zone import clean_domain, find_zone, read_zone

SITE_LENGTH = 64
"""The most characters of the site's name: ACM's limit for a certificate's first name (RequestCertificate)."""

_PARAMETERS = {  # setting → the template's parameter that gets its value unchanged
    "site": "SiteHost",
    "email": "AlarmEmail",
    "max_runtime": "MaxRuntime",
    "budget": "MonthlyBudget",
    "vpc": "VpcId",
    "subnets": "SubnetIds",
    "log_days": "LogRetentionDays",
    "rate": "RequestsPerSecond",
    "servers": "ServersHost",
    "server_names": "ServerNames",
    "plain_clients": "PlainClients",
    "port": "ServerPort",
}


def option(parameter: str) -> str:
    """Return the option that sets a parameter of the template; the parameter's name if there is no such option."""
    return next(
        (
            f"--{name.replace('_', '-')}"
            for name, name_of_parameter in _PARAMETERS.items()
            if name_of_parameter == parameter
        ),
        parameter,
    )


@dataclass(frozen=True)
class StackSettings:
    """The administrator's options. None: the stack keeps its value; a new stack gets the template's default."""

    domain: Annotated[
        str | None,
        Option(
            "--domain",
            help="The domain below which servers get names; its zone is in Route 53. Without one, the site has AWS's "
            "address, and servers have certificates for their own addresses; '' goes back to that.",
        ),
    ] = None
    site: Annotated[
        str | None, Option("--site", help="First part of the address that participants open; `study` if never given.")
    ] = None
    servers: Annotated[
        str | None,
        Option("--servers", help="The level below the domain where servers get names; `servers` if never given."),
    ] = None
    zone: Annotated[
        str | None, Option("--zone", help="The hosted zone's id, if the domain alone does not tell which.")
    ] = None
    email: Annotated[str | None, Option("--email", help="Where alarms go; '' for nowhere.")] = None
    max_runtime: Annotated[
        int | None, Option("--max-runtime", min=5, max=1440, help="Minutes after which any server is stopped.")
    ] = None
    budget: Annotated[
        int | None, Option("--budget", min=0, help="US dollars a month of the account before a warning; 0: none.")
    ] = None
    vpc: Annotated[str | None, Option("--vpc", help="A VPC of yours for the servers; '' for one of their own.")] = None
    subnets: Annotated[str | None, Option("--subnets", help="Public subnets of that VPC, separated by commas.")] = None
    log_days: Annotated[
        int | None, Option("--log-days", help="Days that logs are kept: 1, 3, 5, 7, 14, 30, 60, 90 …")
    ] = None
    rate: Annotated[
        int | None, Option("--rate", min=10, max=10000, help="HTTP requests a second that the site answers.")
    ] = None
    server_names: Annotated[
        str | None,
        Option("--server-names", help="`hash`, or `userId` to let projects name servers after participants' ids."),
    ] = None
    plain_clients: Annotated[
        str | None,
        Option("--plain-clients", help="`refused`, or `allowed` to let projects have a front end without tokens."),
    ] = None
    port: Annotated[
        int | None, Option("--port", help="Where servers listen, 443 or 5000; studies registered from then on use it.")
    ] = None

    def parameters(
        self,
        account: Account,
        defaults: Mapping[str, str | None],
        previous: Mapping[str, str],
        code_bucket: str,
        subnets: Sequence[str] = (),
    ) -> dict[str, str]:
        """Make the template's parameters: of each the option, else the stack's present value, else the default.

        `subnets` are the present installation's. Raises `Problem` if values do not fit together.
        """
        given = {parameter: getattr(self, setting) for setting, parameter in _PARAMETERS.items()}
        values = {name: value for name, value in defaults.items() if value is not None}
        values |= {name: value for name, value in previous.items() if name in defaults}
        values |= {name: str(value).strip() for name, value in given.items() if value is not None}
        if values.get("SiteHost") and values.get("SiteHost") == values.get("ServersHost"):
            raise Problem(
                f"--site and --servers are both {values['SiteHost']}.",
                "Servers get their names beside the site: give two.",
            )
        values["SubnetIds"] = ",".join(filter(None, map(str.strip, values.get("SubnetIds", "").split(","))))
        if bool(values.get("VpcId")) != bool(values["SubnetIds"]):
            raise Problem(
                "--vpc and --subnets go together.", "Give both, or both as '' for a VPC of the installation's."
            )
        values |= self._addresses(account, previous) | {"CodeBucket": code_bucket}
        if (limit := concurrency.unreserved_or_none(account)) is not None:
            values |= concurrency.parameters(limit)
        site = site_host(values)
        if len(site) > SITE_LENGTH:
            raise Problem(
                f"The site's address would have {len(site)} characters ({site}); AWS's certificates allow "
                f"{SITE_LENGTH}.",
                "Choose a shorter --site or --domain.",
            )
        if values.get("VpcId"):  # the zones stay, unused, for a later VPC of its own
            values |= {name: previous.get(name, "") for name in availability_zones.PARAMETERS}
        elif set(availability_zones.PARAMETERS) <= set(defaults):
            values |= availability_zones.choose(account, previous, () if previous.get("VpcId") else subnets)
        return {name: value for name, value in values.items() if name in defaults}

    def _addresses(self, account: Account, previous: Mapping[str, str]) -> dict[str, str]:
        before = previous.get("RootDomain", "")
        domain = before if self.domain is None else clean_domain(self.domain) if self.domain.strip() else ""
        if not domain:
            if self.zone:
                raise Problem("--zone is the zone of a domain.", "Give --domain too, or leave --zone out.")
            return {"RootDomain": "", "HostedZoneId": ""}
        if self.zone:
            zone = read_zone(account, self.zone)
            if not zone.holds(domain):
                raise Problem(
                    f"The hosted zone {self.zone} is of {zone.domain}, and {domain} is not below that.",
                    "Give the zone of your domain, or leave --zone out: the command finds the zone.",
                )
            return {"RootDomain": domain, "HostedZoneId": zone.id}
        if domain == before and previous.get("HostedZoneId"):
            return {"RootDomain": domain, "HostedZoneId": previous["HostedZoneId"]}
        return {"RootDomain": domain, "HostedZoneId": find_zone(account, domain).id}


def taking_settings(command: Callable[..., int]) -> Callable[..., int]:
    """Turn a function with the parameter `settings` into a typer command with an option for each setting."""
    hints = get_type_hints(StackSettings, include_extras=True)
    options = [
        inspect.Parameter(
            field.name, inspect.Parameter.KEYWORD_ONLY, default=field.default, annotation=hints[field.name]
        )
        for field in fields(StackSettings)
    ]

    @functools.wraps(command)
    def with_options(*folder: Any, **given: Any) -> int:
        chosen = {option.name: given.pop(option.name) for option in options if option.name in given}
        return command(*folder, settings=StackSettings(**chosen), **given)

    signature = inspect.signature(command, eval_str=True)
    parameters = [
        option
        for parameter in signature.parameters.values()
        for option in (options if parameter.name == "settings" else [parameter])
    ]
    with_options.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    return with_options
