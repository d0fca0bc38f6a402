"""Estimates what a study will cost: a line for each thing that AWS bills. Pure.

The numbers of calls come from `make bench`, which counts them for the example study of five steps: 31 from the link to
the clean-up in a running study, 40 for a participant alone (docs/architecture.md, "What a participant costs"). They are
scaled by the number of steps. A figure that is not measured is assumed, low, likely and high; `assumptions` says which.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from hippodrome.console.formatting import count
from hippodrome.deployment.cost import prices
from hippodrome.deployment.cost.prices import HOURS, Range, server_hour

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
# What infra/template.yml makes, and what of it is free unless the account uses that already.
QUEUES, ALARMS, METRICS, DASHBOARDS = 3, 25, 6, 1
SWEEPS = 12 * HOURS  # every five minutes
SWEEP_WRITES, SWEEP_READS = 3, 4  # listings and reads of a sweep of an installation without servers


class CostLine(NamedTuple):
    """One line of the estimate: what is billed, the likely amount of it, and what it costs in US dollars."""

    what: str
    amount: str
    usd: Range


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
        return self.games and self.players > 1

    @property
    def lobby_polls(self) -> Range:
        """The number of requests that the pages of all participants make while they wait in the lobby."""
        if not self.has_sessions:
            return Range()
        most = self.patience / 2
        return Range(min(LOBBY_POLLS.low, most), min(LOBBY_POLLS.likely, most), most) * self.participants

    @property
    def server_minutes(self) -> Range:
        """The minutes of one server, from its start message to its end."""
        if not self.games:
            return Range()
        longest = float(self.max_runtime)
        if self.minutes is not None:
            return Range(self.minutes, self.minutes, max(self.minutes, longest))
        return Range(longest / 4, longest / 2, longest)


def study_lines(study: StudyToEstimate) -> list[CostLine]:
    """Estimate what participants cost, a line for each thing."""
    people, servers = study.participants, study.servers
    polls = POLLS * (people if study.games else 0)
    pages = Range.exactly(people * (2 * study.steps - 1)) + polls + study.lobby_polls  # a GET and a POST for each step
    signed, workers = SIGNED * servers, WORKERS * servers
    http = pages + signed
    gb_seconds = (pages * NEXT_STEP_GB + signed * WORKER_GB) * NEXT_STEP_SECONDS + workers * WORKER_SECONDS * WORKER_GB
    scale = people * study.steps / BENCH_STEPS
    # Each poll of the waiting page is one more read, each presigned request two more. A poll in the lobby reads the
    # membership and the decisions, lists the entries, and writes the participant's own entry.
    reads = S3_READS * scale + Range.exactly(TRIAL_READS * servers) + signed * 2 + polls + study.lobby_polls * 2
    writes = Range.exactly(S3_WRITES * scale + TRIAL_WRITES * servers) + study.lobby_polls * 2
    messages = workers * 3  # sent, received, deleted
    frames = study.server_minutes * PLAYED * (60 * study.frame_rate)
    megabytes = people / 1e6  # turns kB of each participant into GB of all
    sent = (frames * FRAME_KB + PAGE_LOADS * (study.steps * PAGE_KB)) * megabytes
    recorded = frames * (PICTURE_KB if study.observations else RECORDED_KB)
    kept, logged = (recorded + Range.exactly(ANSWERS_KB)) * megabytes, LOG_KB * megabytes
    return [
        *_server_lines(study),
        CostLine(
            "Functions (Lambda)",
            f"{gb_seconds.likely:,.0f} GB-s",
            gb_seconds * prices.LAMBDA_GB_SECOND + (http + workers) * prices.LAMBDA_REQUEST,
        ),
        CostLine("HTTP API", f"{http.likely:,.0f} requests", http * prices.HTTP_REQUEST),
        CostLine(
            "S3 requests",
            f"{(reads + writes).likely:,.0f} requests",
            reads * prices.S3_READ + writes * prices.S3_WRITE,
        ),
        CostLine(
            "Messages and DNS (SNS, SQS, Route 53)",
            f"{messages.likely:,.0f} requests",
            messages * prices.SQS_REQUEST
            + Range.exactly(PUBLISHES * servers * prices.SNS_PUBLISH)
            + DNS_QUERIES * servers * prices.DNS_QUERY,
        ),
        CostLine("Data to participants", f"{sent.likely:,.2f} GB", sent * prices.OUT_GB),
        CostLine(
            f"Data kept in S3, {MONTHS_KEPT.likely} months",
            f"{kept.likely:,.2f} GB",
            kept * MONTHS_KEPT * prices.S3_GB_MONTH,
        ),
        CostLine("Logs", f"{logged.likely:,.3f} GB", logged * (prices.LOG_GB + 3 * prices.LOG_GB_MONTH)),
    ]


def _server_lines(study: StudyToEstimate) -> list[CostLine]:
    if not study.games:
        return []
    hours = study.server_minutes * study.servers * (1 / 60)
    hour, on_demand = (server_hour(study.cpu, study.memory, spot=spot) for spot in (study.spot, False))
    address = Range.exactly(prices.IPV4_HOUR)
    # If Spot has no room, a server runs on demand; in the worst case all servers do.
    machine = Range(hour.low, hour.likely, on_demand.high) + address * -1
    size = f"{study.cpu:g} vCPU, {study.memory:g} GB"
    kind = "Fargate Spot" if study.spot else "Fargate"
    return [
        CostLine(f"Servers ({kind}, {size})", f"{hours.likely:,.1f} h", hours * machine),
        CostLine("Public IPv4 addresses", f"{hours.likely:,.1f} h", hours * address),
    ]


def month_lines() -> list[CostLine]:
    """Estimate what a month costs without participants. The high figures are without free tiers."""
    # Five pollers of Lambda ask each queue; a request to an empty queue takes 20 seconds. Lambda reduces five to two
    # only for mappings without a maximum concurrency (Developer Guide, "Configuring scaling behavior for SQS").
    asked = QUEUES * 5 * HOURS * 180
    sweeps = SWEEP_SECONDS * (SWEEPS * WORKER_GB)
    requests = SWEEPS * (SWEEP_WRITES * prices.S3_WRITE + SWEEP_READS * prices.S3_READ)
    return [
        CostLine("Hosted zone, with a domain", "1", Range(0, prices.ZONE_MONTH, prices.ZONE_MONTH)),
        _fixed("Alarms", ALARMS, 10, prices.ALARM_MONTH),
        _fixed("Metrics", METRICS, 10, prices.METRIC_MONTH),
        _fixed("Dashboard", DASHBOARDS, 3, prices.DASHBOARD_MONTH),
        _fixed("Requests to the queues (SQS)", asked, 1_000_000, prices.SQS_REQUEST),
        CostLine(
            "Sweeps (Lambda, S3)",
            f"{SWEEPS:,}",
            Range(0, sweeps.likely, sweeps.high) * prices.LAMBDA_GB_SECOND + Range.exactly(requests),
        ),
        CostLine("Images (ECR)", f"{IMAGE_GB.likely:,.1f} GB", IMAGE_GB * prices.ECR_GB_MONTH),
        CostLine("NAT gateway, load balancer, database", "none", Range()),
    ]


def _fixed(what: str, number: int, free: int, price: float) -> CostLine:
    """Return a line for so many, of which `free` are free, unless the account uses these already."""
    least = max(0, number - free) * price
    return CostLine(what, f"{number:,}", Range(least, least, number * price))


def assumptions(study: StudyToEstimate) -> list[str]:
    """Write the assumptions of the estimate, in sentences."""
    sentences = [f"{count(study.participants, 'participant')}, and each does all {study.steps} steps."]
    if not study.games:
        return sentences
    low, likely, high = study.server_minutes
    minutes = f"{likely:g} minutes likely" if low == likely else f"{low:g} to {high:g} minutes, {likely:g} likely"
    whom = f" {study.players}" if study.has_sessions else ""
    sentences.append(f"A server for each{whom}: {minutes}, {high:g} at most (maxRuntime).")
    if study.minutes is None:
        sentences[-1] += " Give the mean time with --minutes: it decides most of the cost."
    hour, on_demand = (server_hour(study.cpu, study.memory, spot=spot).likely for spot in (True, False))
    sentences.append(f"An hour of a server, with its address: ${hour:.3f} on Spot, ${on_demand:.3f} on demand.")
    if study.has_sessions:
        wait = min(2 * LOBBY_POLLS.likely, study.patience)
        sentences.append(
            f"Each waits {wait:g} seconds in the lobby, {study.patience:g} at most. A server that is started ahead for "
            f"{study.players} people who do not come runs for up to {UNUSED_AHEAD} minutes, and is not counted."
        )
    if study.at_link:
        link = f"Every {study.players} opened links start" if study.has_sessions else "Every opened link starts"
        unused = UNUSED_AHEAD if study.has_sessions else UNUSED
        sentences.append(f"{link} a server. Those of people who look and leave run for {unused} minutes: not counted.")
    sentences.append(
        f"Pictures of {FRAME_KB.likely:g} kB (a flat game), {study.frame_rate:g} a second; high: {FRAME_KB.high:g} "
        "kB, the JPEG of a texture of 600 x 400 pixels that moves in each. Larger ones, or lossless, take more."
    )
    if study.spot:
        sentences.append("Likely all on Spot at 65 % off; low 70 % off; high all on demand because Spot has no room.")
    return sentences


def total(lines: Iterable[CostLine]) -> Range:
    """Return the sum of the lines."""
    return sum((line.usd for line in lines), Range())
