"""What AWS charges: list prices in US dollars, in one table with its date and the source of each price.

The prices hold for us-east-1 (N. Virginia), without taxes, savings plans, credits and, unless it says so, free
tiers. Other regions cost up to about a third more; `current` asks AWS's Price List API for Fargate's prices there.

AWS's pricing pages fill in their figures by scripts. Prices with `twice` (the default) were found in at least one more
place of 2026 that quotes the Price List API or the page; the others are as AWS's page has had them for years.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

REGION = "us-east-1"
DATE = "2026-11-21"
HOURS = 730  # in a month, as AWS computes
FARGATE_MINIMUM = 60  # seconds of a task that are billed at least (Linux)


@dataclass(frozen=True)
class Range:
    """An estimate: the low, the likely and the high figure."""

    low: float = 0.0
    likely: float = 0.0
    high: float = 0.0

    @classmethod
    def exactly(cls, amount: float) -> Range:
        """Make a range whose three figures are this amount."""
        return cls(amount, amount, amount)

    def __iter__(self) -> Iterator[float]:
        yield from (self.low, self.likely, self.high)

    def __add__(self, other: Range) -> Range:
        return Range(self.low + other.low, self.likely + other.likely, self.high + other.high)

    def __mul__(self, times: Range | float) -> Range:
        """Multiply by a number, or each of the three figures by that of another range."""
        by = times if isinstance(times, Range) else Range.exactly(times)
        return Range(self.low * by.low, self.likely * by.likely, self.high * by.high)

    def as_json(self) -> dict[str, float]:
        """Return the three figures, rounded to a hundredth of a cent."""
        return {"low": round(self.low, 4), "likely": round(self.likely, 4), "high": round(self.high, 4)}


Usd = Range  # in US dollars


class Price(NamedTuple):
    """The price of one `unit` in US dollars, and the page that says so."""

    usd: float
    unit: str
    source: str
    twice: bool = True  # whether a second place confirms the price


class Prices(NamedTuple):
    """The table of prices. `region` is the region of Fargate's prices; all other prices hold for `REGION`."""

    # Fargate, Linux on x86: billed by the second, a minute at least, from the image's download to the task's end.
    vcpu_hour: Price = Price(0.04048, "vCPU-hour", "aws.amazon.com/fargate/pricing; AmazonECS USE1-Fargate-vCPU-Hours")
    gb_hour: Price = Price(0.004445, "GB-hour", "aws.amazon.com/fargate/pricing; AmazonECS USE1-Fargate-GB-Hours")
    # Since February 2024 AWS charges for every public IPv4 address, also for those that Fargate assigns.
    ipv4_hour: Price = Price(0.005, "address-hour", "aws.amazon.com/vpc/pricing")
    lambda_request: Price = Price(0.20e-6, "request", "aws.amazon.com/lambda/pricing")
    lambda_gb_second: Price = Price(0.0000133334, "GB-second, arm64", "aws.amazon.com/lambda/pricing")
    http_request: Price = Price(1.00e-6, "request", "aws.amazon.com/api-gateway/pricing, HTTP APIs")
    s3_write: Price = Price(5.0e-6, "PUT, POST or LIST", "aws.amazon.com/s3/pricing", False)
    s3_read: Price = Price(0.4e-6, "GET", "aws.amazon.com/s3/pricing", False)
    s3_gb_month: Price = Price(0.023, "GB-month", "aws.amazon.com/s3/pricing")
    sns_publish: Price = Price(0.50e-6, "publish; deliveries to SQS are free", "aws.amazon.com/sns/pricing")
    sqs_request: Price = Price(0.40e-6, "request", "aws.amazon.com/sqs/pricing")
    scheduler_invocation: Price = Price(
        1.00e-6, "invocation; 14 million a month free", "aws.amazon.com/eventbridge/pricing"
    )
    zone_month: Price = Price(0.50, "hosted zone-month", "aws.amazon.com/route53/pricing", False)
    dns_query: Price = Price(0.40e-6, "query; changes are free", "aws.amazon.com/route53/pricing", False)
    log_gb: Price = Price(0.50, "GB of logs taken in", "aws.amazon.com/cloudwatch/pricing")
    log_gb_month: Price = Price(0.03, "GB-month of logs kept", "aws.amazon.com/cloudwatch/pricing", False)
    alarm_month: Price = Price(0.10, "alarm-month; ten are free", "aws.amazon.com/cloudwatch/pricing", False)
    dashboard_month: Price = Price(3.00, "dashboard-month; three are free", "aws.amazon.com/cloudwatch/pricing")
    metric_month: Price = Price(0.30, "metric-month; ten are free", "aws.amazon.com/cloudwatch/pricing")
    ecr_gb_month: Price = Price(0.10, "GB-month", "aws.amazon.com/ecr/pricing", False)
    out_gb: Price = Price(0.09, "GB to the Internet; 100 GB a month free", "aws.amazon.com/ec2/pricing/on-demand")
    explorer_request: Price = Price(
        0.01, "request to Cost Explorer", "aws.amazon.com/aws-cost-management/pricing", False
    )

    region: str = REGION
    date: str = DATE

    # What Spot costs, as a share of the on-demand price. AWS says "up to 70 %" less, and changes it with supply and
    # demand; 67 % less was seen in 2020 (0.01334 a vCPU-hour in eu-west-1) and about 69 % less in 2026 (us-east-1).
    spot_low: float = 0.30
    spot_likely: float = 0.35
    spot_high: float = 0.50

    def server_hour(self, cpu: float, memory: float, *, spot: bool) -> Usd:
        """Compute what a server with its public address costs in an hour. `cpu` in vCPU, `memory` in GB."""
        machine = cpu * self.vcpu_hour.usd + memory * self.gb_hour.usd
        shares = (self.spot_low, self.spot_likely, self.spot_high) if spot else (1.0, 1.0, 1.0)
        low, likely, high = (machine * share + self.ipv4_hour.usd for share in shares)
        return Usd(low, likely, high)

    def note(self, region: str) -> str:
        """Write a sentence on how well these prices fit an installation in `region`."""
        if self.region == region:
            return f"List prices of {self.region}, {self.date}, without taxes and credits."
        return (
            f"List prices of {self.region}, {self.date}: {region} may cost up to a third more "
            "(--current asks AWS for its prices). Without taxes and credits."
        )


def current(client: Any, region: str, today: str) -> Prices:
    """Ask AWS for today's prices of Fargate in `region`. Return the table with them; the other prices stay.

    `client` is the boto3 client `pricing` (the Price List API, which is in us-east-1 and free). Raises LookupError if
    the answer has no such prices.
    """
    prices_by_name: dict[str, float] = {}
    pages = client.get_paginator("get_products").paginate(
        ServiceCode="AmazonECS", Filters=[{"Type": "TERM_MATCH", "Field": "regionCode", "Value": region}]
    )
    for page in pages:
        for text in page["PriceList"]:
            product: Mapping[str, Any] = json.loads(text) if isinstance(text, str) else text
            # USE1-Fargate-vCPU-Hours:perCPU; some regions have no prefix. ARM, Windows and Spot have other names.
            usage = str(product.get("product", {}).get("attributes", {}).get("usagetype", ""))
            prefix, _, kind = usage.rpartition("Fargate-")
            price = _on_demand(product)
            if price and (not prefix or (prefix.endswith("-") and prefix.count("-") == 1)):
                prices_by_name[kind] = price
    try:
        vcpu, gb = prices_by_name["vCPU-Hours:perCPU"], prices_by_name["GB-Hours"]
    except KeyError:
        raise LookupError(f"AWS's price list has no Fargate prices for {region}") from None
    table = Prices()
    source = "AWS Price List API, AmazonECS"
    return table._replace(
        vcpu_hour=Price(vcpu, table.vcpu_hour.unit, source),
        gb_hour=Price(gb, table.gb_hour.unit, source),
        region=region,
        date=f"{today} (Fargate; the rest {DATE}, {REGION})",
    )


def _on_demand(product: Mapping[str, Any]) -> float | None:
    """Return the product's first on-demand price above zero; None if there is none."""
    for term in product.get("terms", {}).get("OnDemand", {}).values():
        for dimension in term.get("priceDimensions", {}).values():
            amount = float(dimension.get("pricePerUnit", {}).get("USD", 0))
            if amount > 0:
                return amount
    return None
