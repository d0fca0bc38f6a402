"""The AWS regions that Hippodrome can be installed in, and the zones of a region that run Fargate.

CloudFormation refuses a template that names a type which the region does not have, even where a condition leaves the
resource out ("Unrecognized resource types", cloudformation-coverage-roadmap 2177). `tests/infra/test_regions.py` holds
the list against the types of `infra/template.yml`. Of these types, many regions lack the budget alone: there the
template has none.
"""

from __future__ import annotations

from collections.abc import Mapping

from hippodrome.console.problem import Problem

SUPPORTED: Mapping[str, str] = {
    "af-south-1": "Cape Town",
    "ap-east-1": "Hong Kong",
    "ap-northeast-1": "Tokyo",
    "ap-northeast-2": "Seoul",
    "ap-northeast-3": "Osaka",
    "ap-south-1": "Mumbai",
    "ap-south-2": "Hyderabad",
    "ap-southeast-1": "Singapore",
    "ap-southeast-2": "Sydney",
    "ap-southeast-3": "Jakarta",
    "ap-southeast-4": "Melbourne",
    "ca-central-1": "Canada (Montréal)",
    "ca-west-1": "Calgary",
    "eu-central-1": "Frankfurt",
    "eu-central-2": "Zurich",
    "eu-north-1": "Stockholm",
    "eu-south-1": "Milan",
    "eu-south-2": "Spain",
    "eu-west-1": "Ireland",
    "eu-west-2": "London",
    "eu-west-3": "Paris",
    "il-central-1": "Tel Aviv",
    "me-central-1": "United Arab Emirates",
    "sa-east-1": "São Paulo",
    "us-east-1": "N. Virginia",
    "us-east-2": "Ohio",
    "us-west-1": "N. California",
    "us-west-2": "Oregon",
}
"""By region, its name. Each region has every service of the commands, and every resource type of the template, or all
but the budget."""

WITHOUT_BUDGETS = frozenset(
    {"af-south-1", "ap-east-1", "ap-northeast-3", "ap-south-2", "ap-southeast-3", "ap-southeast-4", "ca-west-1"}
    | {"eu-central-2", "eu-north-1", "eu-south-1", "eu-south-2", "il-central-1", "me-central-1"}
)
"""The regions whose CloudFormation makes no budgets."""

FARGATE_ZONES: Mapping[str, frozenset[str]] = {
    "ap-northeast-1": frozenset({"apne1-az1", "apne1-az2", "apne1-az4"}),
    "ca-central-1": frozenset({"cac1-az1", "cac1-az2"}),
    "us-west-1": frozenset({"usw1-az1", "usw1-az3"}),
}
"""By region, the ids of its zones that run Fargate. Regions in which all zones do are left out.

Source: "Supported Regions for Amazon ECS on AWS Fargate", ECS's developer guide. Earlier editions restricted
ca-central-1 to these two zones, and editions of 2026 do not. These two zones run Fargate in either case.
"""


def check(region: str) -> None:
    """Raise `Problem` if Hippodrome cannot be installed in this region."""
    if region in SUPPORTED:
        return
    near = [name for name in SUPPORTED if name.partition("-")[0] == region.partition("-")[0]]
    raise Problem(
        f"Hippodrome cannot be installed in {region}: not every service that it needs is there.",
        f"Choose one of these with AWS_REGION or --region: {', '.join(near or SUPPORTED)}.",
    )


def runs_fargate(region: str, zone_id: str) -> bool:
    """Whether Fargate runs tasks in this zone. `zone_id`: such as usw1-az1, since names of zones differ by account."""
    return zone_id in FARGATE_ZONES.get(region, {zone_id})
