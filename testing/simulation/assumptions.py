"""Writes the simulation's assumptions in words, from the constants that it uses, each with its source if there is one."""

from __future__ import annotations

from collections.abc import Mapping

from testing.simulation import functions
from testing.simulation.cloud import CONCURRENCY, LATENCY, QUOTAS
from testing.simulation.conditions import SLOW_FOR, Conditions
from testing.simulation.people import PATIENCE, PLAY, POLLS, READ, RELOADS
from testing.simulation.ports import MAX_CHANGES, PAGE
from testing.simulation.tasks import ADDRESSES, DEPROVISIONED
from testing.simulation.world import HOP, LOOPS, SWEEP_EVERY, TIMEOUTS, WIRES

OURS = "our assumption"


def assumptions(conditions: Conditions) -> Mapping[str, str]:
    """Return, by name, the text of each assumption that decides the figures."""
    median, sigma, longest = conditions.starts
    rate = ", ".join(f"{name} {quota[0]:g}/s (burst {quota[1]:g})" for name, quota in QUOTAS.items())
    delays = ", ".join(f"{name} {_span(span)}" for name, span in {**LATENCY, "s3": conditions.s3}.items())
    queues = ", ".join(f"{name} {wire.concurrency} at once, batches of {wire.batch}" for name, wire in WIRES.items())
    return {
        "start of a task": f"log-normal, median {median:g} s, sigma {sigma:g}, at most {longest:g} s ({OURS})",
        "DNS change until INSYNC": f"{_span(conditions.propagation)} (Route 53's FAQ: usually within 60 seconds)",
        "Route 53 is slow": f"{conditions.slow_zone:.0%} of the time, for {SLOW_FOR:g} s: "
        f"{_span(conditions.slow_propagation)} (libdns/route53 issue 14; shares: {OURS})",
        "zone busy after a change": f"{_span(conditions.busy_zone)} ({OURS})",
        "changes of the zone in a call": f"{MAX_CHANGES:,}, an UPSERT counts twice (Route 53 Developer Guide, Quotas)",
        "certificate of an address": _span(conditions.authority) + f" after RUNNING ({OURS})"
        if conditions.authority
        else "none: servers have names",
        "quotas": f"{rate} (ECS Developer Guide, API throttling and Fargate throttling quotas; Route 53, Quotas)",
        "latency of a call": f"{delays} ({OURS})",
        "S3": f"a read or listing shows every write answered before it; a listing is a call for {PAGE:,} keys (S3 User "
        "Guide, data consistency model); LastModified has whole seconds (minio/minio-go pull request 1638)",
        "Spot": _spot(conditions),
        "tasks that end before they run": f"{conditions.stillborn:.0%} ({OURS})",
        "participants": f"read a page for {_span((0.5 * READ, 1.5 * READ))} and play for {PLAY:g} s where a row says nothing "
        f"else; load the waiting page again after {RELOADS:g} s, give up after {PATIENCE:g} s there; a game waits for "
        f"them for {conditions.idle:g} s ({OURS})",
        "events": f"{conditions.late:.0%} come 1 to 20 s late, {conditions.repeated:.0%} come twice ({OURS})",
        "events lost": f"{conditions.lost:.1%} ({OURS}; EventBridge calls the delivery of ECS's events durable)",
        "addresses seen late": f"{conditions.late_addresses:.0%}, {_span(conditions.address_late)} after the event that the "
        f"task runs ({OURS}; EC2 API Reference, eventual consistency)",
        "topic to queue": f"{_span(HOP)} ({OURS})",
        "queue to function": f"{_span(functions.POLL)} ({OURS}); {queues} (infra/template.yml)",
        "pollers of a queue": f"{functions.BATCHES} batches at once, {functions.MORE_BATCHES:g} more for each "
        "second of backlog (AWS Compute Blog, November 2023)",
        "batches that are throttled": "come again after the visibility timeout, which costs each message a receive "
        "(Lambda Developer Guide, SQS backoff strategy: Lambda tries again within it, which is left out)",
        "loops": f"the invocation after {functions.HOPS} of a function in one chain is dropped; a batch inherits the "
        f"highest count of its messages; allowed to {' and '.join(sorted(LOOPS)) or 'none'} (Lambda Developer Guide, "
        "recursive loop detection)",
        "cold start": f"{_span(functions.COLD)} ({OURS})",
        "processor time of functions": "0 s: calls and cold starts alone take time",
        "functions end after": ", ".join(f"{name} {seconds} s" for name, seconds in TIMEOUTS.items()),
        "functions at once": f"{CONCURRENCY:,} in the account (Lambda quotas; a new account may have 10)",
        "waiting page asks": f"every {POLLS['first']:g} s at first, every {POLLS['longest']:g} s later, every "
        f"{POLLS['naming']:g} s while the server is being named (hippodrome/web/game/waiting.js)",
        "network interface goes": f"{_span(DEPROVISIONED)} after the container has ended ({OURS})",
        "sweep": f"every {SWEEP_EVERY:g} s (infra/template.yml)",
        "addresses": f"{ADDRESSES:,}: what the subnets of infra/template.yml hold",
    }


def _spot(conditions: Conditions) -> str:
    share = f"{conditions.interrupted:.0%} of its tasks are taken back"
    untold = f"{conditions.untold:.0%} of them without a stopCode (aws/containers-roadmap issue 1565)"
    after = f" after {_span(conditions.interrupted_after)}, {untold}" if conditions.interrupted else ""
    return f"{'sold out' if conditions.no_spot(0.0) else 'has room'}, {share}{after} ({OURS})"


def _span(span: tuple[float, float]) -> str:
    return f"{span[0]:g} to {span[1]:g} s"
