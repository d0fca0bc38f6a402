"""AWS's list prices in US dollars, each with its unit and the page that states it; and ranges of amounts.

They hold for us-east-1 (N. Virginia) on `DATE`, without taxes, savings plans, credits and, unless a comment says so,
free tiers. Other regions cost up to about a third more. `note` tells readers how old the prices are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date

REGION = "us-east-1"
DATE = date(2026, 11, 21)
HOURS = 730  # in a month, as AWS computes
FARGATE_MINIMUM = 60  # seconds of a task that are billed at least (Linux)

# aws.amazon.com/fargate/pricing, Linux on x86: billed by the second, from the image's download to the task's end
VCPU_HOUR = 0.04048  # AmazonECS USE1-Fargate-vCPU-Hours
GB_HOUR = 0.004445  # AmazonECS USE1-Fargate-GB-Hours
# What Spot costs, as a share of that. AWS says "up to 70 %" less, and changes it with supply and demand; 67 % less was
# seen in 2020 (0.01334 a vCPU-hour in eu-west-1) and about 69 % less in 2026 (us-east-1).
SPOT_SHARES = (0.30, 0.35, 0.50)
IPV4_HOUR = 0.005  # aws.amazon.com/vpc/pricing: every public address, also those that Fargate assigns

LAMBDA_REQUEST = 0.20e-6  # aws.amazon.com/lambda/pricing
LAMBDA_GB_SECOND = 0.0000133334  # the same, arm64
HTTP_REQUEST = 1.00e-6  # aws.amazon.com/api-gateway/pricing, HTTP APIs
S3_WRITE = 5.0e-6  # aws.amazon.com/s3/pricing: a PUT, POST or LIST
S3_READ = 0.4e-6  # the same: a GET
S3_GB_MONTH = 0.023  # the same
SNS_PUBLISH = 0.50e-6  # aws.amazon.com/sns/pricing; deliveries to SQS are free
SQS_REQUEST = 0.40e-6  # aws.amazon.com/sqs/pricing; a million a month are free
ZONE_MONTH = 0.50  # aws.amazon.com/route53/pricing
DNS_QUERY = 0.40e-6  # the same; changes are free
LOG_GB = 0.50  # aws.amazon.com/cloudwatch/pricing: taken in
LOG_GB_MONTH = 0.03  # the same: kept
ALARM_MONTH = 0.10  # the same; ten are free
DASHBOARD_MONTH = 3.00  # the same; three are free
METRIC_MONTH = 0.30  # the same; ten are free
ECR_GB_MONTH = 0.10  # aws.amazon.com/ecr/pricing
OUT_GB = 0.09  # aws.amazon.com/ec2/pricing/on-demand: to the Internet; 100 GB a month are free
EXPLORER_REQUEST = 0.01  # aws.amazon.com/aws-cost-management/pricing


@dataclass(frozen=True)
class Range:
    """An estimate, such as of US dollars: the low, the likely and the high figure."""

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


def server_hour(cpu: float, memory: float, *, spot: bool) -> Range:
    """Compute what a server with its public address costs in an hour. `cpu` in vCPU, `memory` in GB."""
    machine = Range(*SPOT_SHARES) if spot else Range.exactly(1)
    return machine * (cpu * VCPU_HOUR + memory * GB_HOUR) + Range.exactly(IPV4_HOUR)


def note(region: str, today: date) -> str:
    """Write a sentence on how well these prices fit an installation in `region`."""
    parts = [f"List prices of {REGION}, {DATE}, without taxes and credits"]
    if region != REGION:
        parts.append(f"{region} may cost up to a third more")
    if (today - DATE).days > 365:
        parts.append("they are more than a year old, so compare aws.amazon.com/fargate/pricing")
    return "; ".join(parts) + "."
