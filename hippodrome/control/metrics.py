"""Writes CloudWatch metrics. The sweep reports how many servers run, the age of the oldest, and what it did.
Functions that see servers fail report how many failed, by `causes.FailureCategory`. No dimension names a project:
alarms watch dimensions that are known beforehand. `hippodrome status` names the project.

The metrics are lines of the log in CloudWatch's embedded metric format, which needs no call and no permission. Cold
starts take no longer: Powertools loads its metrics with its Logger. `infra/template.yml` has the alarms and dashboard.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from datetime import timedelta
from typing import TYPE_CHECKING

from aws_lambda_powertools.metrics import EphemeralMetrics, MetricUnit

from hippodrome.control.servers.causes import Cause

if TYPE_CHECKING:  # the zips of functions that start servers do not contain the sweep
    from hippodrome.control.servers.sweep import RunningServers, SweepResult

NAMESPACE = "Hippodrome"
DIMENSION = "Stack"
FAULT = "Fault"


def report(stack: str, running: RunningServers, result: SweepResult) -> None:
    """Write a sweep's metrics as one line of the log. `stack` names the installation."""
    metrics = EphemeralMetrics(namespace=NAMESPACE)
    metrics.add_dimension(DIMENSION, stack)
    metrics.add_metric("Servers", MetricUnit.Count, running.count)
    metrics.add_metric("OldestServer", MetricUnit.NoUnit, running.oldest / timedelta(minutes=1))  # minutes
    removed = result.tasks + result.names + result.timers + result.clusters
    metrics.add_metric("LeftoversRemoved", MetricUnit.Count, removed)
    metrics.add_metric("ServersOverdue", MetricUnit.Count, result.overdue)
    metrics.add_metric("ServersLost", MetricUnit.Count, result.lost)
    metrics.add_metric("SweepFailures", MetricUnit.Count, result.failed)
    metrics.flush_metrics()


def report_failures(stack: str, causes: Iterable[Cause]) -> None:
    """Write one line of metrics for each category of failures, with the number of each cause as metadata."""
    counted = Counter(causes)
    for category in sorted({cause.category for cause in counted}):
        numbers = {str(cause): number for cause, number in counted.items() if cause.category is category}
        metrics = EphemeralMetrics(namespace=NAMESPACE)
        metrics.add_dimension(DIMENSION, stack)
        metrics.add_dimension(FAULT, category)
        metrics.add_metadata("causes", numbers)
        metrics.add_metric("ServersFailed", MetricUnit.Count, sum(numbers.values()))
        metrics.flush_metrics()
