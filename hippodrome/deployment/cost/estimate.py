"""Estimates what a study will cost: a line for each thing that AWS bills. Pure.

The numbers of calls come from `make bench`, which counts them for the example study of five steps: 31 from the link to
the clean-up in a running study, 40 for a participant alone (docs/architecture.md, "What a participant costs"). They are
scaled by the number of steps. A figure that is not measured is assumed, low, likely and high; `assumptions` says which.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from hippodrome.console.formatting import count
from hippodrome.deployment.cost.prices import HOURS, Prices, Range, Usd

BENCH_STEPS = 5  # steps of the example study
S3_READS = Range(4, 4, 13)  # GETs of a participant; high: of one who comes alone, with stale caches
S3_WRITES = 13  # PUTs and LISTs of a participant
TRIAL_READS, TRIAL_WRITES = 2, 2  # of a trial server: it reads its certificate, and writes a recording and the answer
SIGNED = Range(4, 6, 20)  # presigned requests of a server: certificate, answer, recordings; more after a loss
PUBLISHES = 2
LOBBY_POLLS = Range(5, 15)  # requests of a page in the lobby, every two seconds, for `patience` seconds at most
POLLS = Range(2, 12, 60)  # requests of the waiting page, every two to four seconds
WORKERS = Range(4, 7, 12)  # invocations of the functions behind queues, for a server: start, task changes, stop
NEXT_STEP_SECONDS = Range(0.05, 0.12, 0.6)  # of a request; high: with a cold start each time
WORKER_SECONDS = Range(0.2, 0.5, 2.0)
SWEEP_SECONDS = Range(0.3, 0.7, 2.0)
NEXT_STEP_GB, WORKER_GB = 1.0, 0.5  # the functions' memory in infra/template.yml
PAGE_KB = 15  # the largest page of the example, with gzip, by `make bench`
PAGE_LOADS = Range(1.0, 1.5, 3.0)
FRAME_KB = Range(0.4, 0.5, 77.0)  # `make bench`: Ms. Pac-Man; high: a JPEG of a scrolling texture, 600 x 400
PLAYED = Range(0.4, 0.6, 1.0)  # the share of a server's time in which it sends frames
RECORDED_KB = Range(0.02, 0.06, 0.2)  # of a step, with gzip, without pictures; each frame counts as a step
PICTURE_KB = Range(1.0, 4.0, 30.0)  # of a step's picture, with `recordObservations`
ANSWERS_KB = 5
LOG_KB = Range(15, 40, 150)  # logs of functions and servers, and the access log
MONTHS_KEPT = Range(1, 12, 36)  # how long answers and recordings are kept
IMAGE_GB = Range(0.3, 0.8, 2.5)  # of a project
UNUSED = 10  # minutes until a server without its participant ends: IDLE_SECONDS in hippodrome/trial/settings.py
UNUSED_AHEAD = 35  # minutes until a server started ahead of a session is stopped: MAX_OPEN, and the next sweep
DNS_QUERIES = Range(4, 10, 40)


class CostLine(NamedTuple):
    """One line of the estimate: what is billed, the likely amount of it, and what it costs."""

    what: str
    amount: str
    usd: Usd


@dataclass(frozen=True)
class StudyToEstimate:
    """A study whose cost is estimated."""

    participants: int
    steps: int
    cpu: float  # vCPU
    memory: float  # GB
    max_runtime: int  # minutes
    minutes: float | None = None  # mean minutes of a server; None: not known
    frame_rate: float = 30  # frames a second
    games: bool = True
    spot: bool = True
    observations: bool = False  # whether recordings hold every picture
    at_link: bool = False  # whether a server starts when a link is opened
    players: int = 1  # participants of a session; they share a server
    patience: float = 300  # seconds that a participant waits in the lobby at most

    @property
    def servers(self) -> int:
        """The number of servers: one for each participant or session; 0 without a game."""
        return math.ceil(self.participants / self.players) if self.games else 0

    @property
    def has_sessions(self) -> bool:
        """Whether several participants share a server."""
        return self.players > 1

    @property
    def lobby_polls(self) -> Range:
        """The number of requests that the pages of all participants make while they wait in the lobby."""
        if not self.games or not self.has_sessions:
            return Range()
        most = self.patience / 2
        return Range(min(LOBBY_POLLS.low, most), min(LOBBY_POLLS.likely, most), most) * self.participants

    @property
    def clients(self) -> int:
        """The number of participants who wait for a server and play; 0 without a game."""
        return self.participants if self.games else 0

    @property
    def server_minutes(self) -> Range:
        """The minutes of one server, from its start message to its end."""
        if not self.games:
            return Range()
        if self.minutes is not None:
            return Range(self.minutes, self.minutes, max(self.minutes, float(self.max_runtime)))
        return Range(self.max_runtime / 4, self.max_runtime / 2, float(self.max_runtime))


def study_lines(study: StudyToEstimate, prices: Prices) -> list[CostLine]:
    """Estimate what participants cost, a line for each thing."""
    return [*_servers(study, prices), *_functions(study, prices), *_small_things(study, prices), *_data(study, prices)]


def _servers(study: StudyToEstimate, prices: Prices) -> list[CostLine]:
    if not study.games:
        return []
    hours = study.server_minutes * study.servers * (1 / 60)
    hour, on_demand = (prices.server_hour(study.cpu, study.memory, spot=spot) for spot in (study.spot, False))
    address = prices.ipv4_hour.usd
    # If Spot has no room, a server runs on demand; in the worst case all servers do.
    machine = Usd(hour.low, hour.likely, on_demand.high) + Usd.exactly(-address)
    size = f"{study.cpu:g} vCPU, {study.memory:g} GB"
    kind = "Fargate Spot" if study.spot else "Fargate"
    return [
        CostLine(f"Servers ({kind}, {size})", f"{hours.likely:,.1f} h", hours * machine),
        CostLine("Public IPv4 addresses", f"{hours.likely:,.1f} h", hours * address),
    ]


class WarmCost(NamedTuple):
    """The cost of all warm servers of a project together in an hour while they wait, on Spot and on demand."""

    project_id: str
    servers: int
    cpu: float  # vCPU of each
    memory: float  # GB
    spot: Usd
    on_demand: Usd


def warm(project_id: str, servers: int, cpu: float, memory: float, prices: Prices) -> WarmCost:
    """Compute what a project's warm servers cost in an hour.

    A server that waits costs as much as one on which a participant plays.
    """
    spot, on_demand = (prices.server_hour(cpu, memory, spot=kind) * servers for kind in (True, False))
    return WarmCost(project_id, servers, cpu, memory, spot, on_demand)


def _functions(study: StudyToEstimate, prices: Prices) -> list[CostLine]:
    pages, signed, workers = _page_requests(study), SIGNED * study.servers, WORKERS * study.servers
    http = pages + signed
    gb_seconds = (pages * NEXT_STEP_GB + signed * WORKER_GB) * NEXT_STEP_SECONDS + workers * WORKER_SECONDS * WORKER_GB
    return [
        CostLine("Lambda requests", f"{(http + workers).likely:,.0f}", (http + workers) * prices.lambda_request.usd),
        CostLine("Lambda time", f"{gb_seconds.likely:,.0f} GB-s", gb_seconds * prices.lambda_gb_second.usd),
        CostLine("HTTP API", f"{http.likely:,.0f} requests", http * prices.http_request.usd),
    ]


def _small_things(study: StudyToEstimate, prices: Prices) -> list[CostLine]:
    scale, servers = study.participants * study.steps / BENCH_STEPS, study.servers
    # Each poll of the waiting page is one more read, each presigned request two more.
    reads = S3_READS * scale + (Range.exactly(TRIAL_READS) + SIGNED * 2) * servers + POLLS * study.clients
    writes = Range.exactly(S3_WRITES * scale + TRIAL_WRITES * servers)
    # A poll in the lobby reads the membership and the decisions, lists the entries (which costs as much as a write),
    # and writes the participant's own entry.
    reads, writes = reads + study.lobby_polls * 2, writes + study.lobby_polls * 2
    messages = WORKERS * (servers * 3)  # sent, received, deleted
    queries = DNS_QUERIES * servers
    return [
        CostLine(
            "S3 requests",
            f"{(reads + writes).likely:,.0f}",
            reads * prices.s3_read.usd + writes * prices.s3_write.usd,
        ),
        CostLine(
            "SNS", f"{servers * PUBLISHES:,} publishes", Usd.exactly(servers * PUBLISHES * prices.sns_publish.usd)
        ),
        CostLine("SQS", f"{messages.likely:,.0f} requests", messages * prices.sqs_request.usd),
        CostLine(
            "EventBridge Scheduler", f"{servers:,} timers at most", Usd(0, 0, servers * prices.scheduler_invocation.usd)
        ),
        CostLine("Route 53 (changes are free)", f"{queries.likely:,.0f} queries", queries * prices.dns_query.usd),
    ]


def _data(study: StudyToEstimate, prices: Prices) -> list[CostLine]:
    per_gb = study.participants / 1e6
    frames = study.server_minutes * PLAYED * (60 * study.frame_rate)
    out = (frames * FRAME_KB + PAGE_LOADS * (study.steps * PAGE_KB)) * per_gb
    kilobytes = PICTURE_KB if study.observations else RECORDED_KB
    stored = (frames * kilobytes + Range.exactly(ANSWERS_KB)) * per_gb
    logged = LOG_KB * per_gb
    label = f"Data kept in S3, {MONTHS_KEPT.likely} months"
    return [
        CostLine("Data to participants", f"{out.likely:,.2f} GB", out * prices.out_gb.usd),
        CostLine(label, f"{stored.likely:,.2f} GB", stored * MONTHS_KEPT * prices.s3_gb_month.usd),
        CostLine("Logs", f"{logged.likely:,.3f} GB", logged * (prices.log_gb.usd + 3 * prices.log_gb_month.usd)),
    ]


def _page_requests(study: StudyToEstimate) -> Range:
    """Return the requests to `next_step`: a GET and a POST for each step, except a POST for the last one; and polls."""
    return Range.exactly(study.participants * (2 * study.steps - 1)) + POLLS * study.clients + study.lobby_polls


SWEEP_REQUESTS = (3, 4)
"""The listings and reads of a sweep of an installation without servers."""


@dataclass(frozen=True)
class FixedResources:
    """The resources of an installation that cost something without participants, as counted in `infra/template.yml`."""

    queues: int = 3  # queues with a function behind them
    alarms: int = 25
    dashboards: int = 1
    metrics: int = 6
    sweeps: int = 12 * HOURS  # every five minutes

    @classmethod
    def of(cls, resources: Mapping[str, Mapping[str, Any]]) -> FixedResources:
        """Count the resources of a template."""
        kinds = [str(resource.get("Type")) for resource in resources.values()]
        return cls(
            queues=kinds.count("AWS::Lambda::EventSourceMapping"),
            alarms=kinds.count("AWS::CloudWatch::Alarm"),
            dashboards=kinds.count("AWS::CloudWatch::Dashboard"),
        )


def month_lines(prices: Prices, fixed: FixedResources) -> list[CostLine]:
    """Estimate what a month costs without participants. The high figures are without free tiers."""
    # Five pollers of Lambda ask each queue; a request to an empty queue takes 20 seconds. Lambda reduces five to two
    # only for mappings without a maximum concurrency (Developer Guide, "Configuring scaling behavior for SQS").
    polls = fixed.queues * 5 * HOURS * 180.0
    sweeps = SWEEP_SECONDS * (fixed.sweeps * WORKER_GB)
    gb_second = prices.lambda_gb_second.usd
    free = {"alarm": 10, "metric": 10, "dashboard": 3, "sqs": 1e6}
    least = max(0.0, polls - free["sqs"])
    return [
        CostLine("Hosted zone, with a domain", "1", Usd(0, prices.zone_month.usd, prices.zone_month.usd)),
        _fixed("Alarms", fixed.alarms, prices.alarm_month.usd, free["alarm"]),
        _fixed("Metrics", fixed.metrics, prices.metric_month.usd, free["metric"]),
        _fixed("Dashboard", fixed.dashboards, prices.dashboard_month.usd, free["dashboard"]),
        CostLine(
            "Asking the queues (SQS)",
            f"{polls:,.0f} requests",
            Usd(least, least, polls) * prices.sqs_request.usd,
        ),
        CostLine("Sweeps (Lambda)", f"{sweeps.likely:,.0f} GB-s", Usd(0, sweeps.likely, sweeps.high) * gb_second),
        CostLine(
            "Sweeps (S3)",
            f"{fixed.sweeps * sum(SWEEP_REQUESTS):,} requests",
            Usd.exactly(
                fixed.sweeps * (SWEEP_REQUESTS[0] * prices.s3_write.usd + SWEEP_REQUESTS[1] * prices.s3_read.usd)
            ),
        ),
        CostLine("Images (ECR)", f"{IMAGE_GB.likely:,.1f} GB", IMAGE_GB * prices.ecr_gb_month.usd),
        CostLine("NAT gateway, load balancer, database", "none", Usd()),
    ]


def _fixed(what: str, number: int, price: float, free: float) -> CostLine:
    """Return a line for so many resources, of which `free` are free, unless the account uses these already."""
    least = max(0.0, number - free) * price
    return CostLine(what, f"{number}", Usd(least, least, number * price))


def assumptions(study: StudyToEstimate) -> list[str]:
    """Write the assumptions of the estimate, in sentences."""
    low, likely, high = study.server_minutes
    minutes = f"{likely:g} minutes likely" if low == likely else f"{low:g} to {high:g} minutes, {likely:g} likely"
    sentences = [f"{count(study.participants, 'participant')}, and each does all {study.steps} steps."]
    if study.games:
        whom = f" {study.players}" if study.has_sessions else ""
        sentences.append(
            f"A server for each{whom}: {minutes}, {high:g} at most (maxRuntime). "
            + ("" if study.minutes is not None else "Give the mean time with --minutes: it decides most of the cost.")
        )
        if study.has_sessions:
            likely_wait = min(2 * LOBBY_POLLS.likely, study.patience)
            sentences.append(
                f"Each waits {likely_wait:g} seconds in the lobby, {study.patience:g} at most. Servers that are "
                f"started ahead and not used are not counted: one for {study.players} people who begin and do not "
                f"come to the game, which runs for {UNUSED_AHEAD:g} minutes at most."
            )
        if study.at_link and study.has_sessions:
            sentences.append(
                f"Every {study.players} opened links start a server. Those of {study.players} people who look and "
                f"leave are not counted here: each runs for up to {UNUSED_AHEAD:g} minutes."
            )
        elif study.at_link:
            sentences.append(
                "Every opened link starts a server. Those of people who look and leave are not counted here: "
                f"each runs for about {UNUSED:g} minutes."
            )
        sentences.append(
            f"Pictures of {FRAME_KB.likely:g} kB (a flat game), {study.frame_rate:g} a second; high: {FRAME_KB.high:g} "
            "kB, the JPEG of a texture of 600 x 400 pixels that moves in each. Larger ones, or lossless, take more."
        )
    if study.games and study.spot:
        sentences.append("Likely all on Spot at 65 % off; low 70 % off; high all on demand because Spot has no room.")
    return [line.strip() for line in sentences]


def total(lines: list[CostLine]) -> Usd:
    """Return the sum of the lines."""
    return sum((line.usd for line in lines), Usd())
