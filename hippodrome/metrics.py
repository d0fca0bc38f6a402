"""What the sweep tells CloudWatch: how many servers run, how old the oldest is, and what it found.

Written to the log in CloudWatch's embedded metric format: no call, no permission. Nor does it make a cold start longer,
since Powertools loads its metrics together with its Logger. `infra/template.yml` has the alarms and the dashboard.
"""

from __future__ import annotations

from datetime import timedelta

from aws_lambda_powertools.metrics import EphemeralMetrics, MetricUnit

from hippodrome.sweep import Census, Swept

NAMESPACE = "Hippodrome"
DIMENSION = "Stack"


def report(stack: str, census: Census, swept: Swept) -> None:
    """Write one line of metrics for the installation of this name."""
    metrics = EphemeralMetrics(namespace=NAMESPACE)
    metrics.add_dimension(DIMENSION, stack)
    metrics.add_metric("Servers", MetricUnit.Count, census.servers)
    metrics.add_metric("OldestServer", MetricUnit.NoUnit, census.oldest / timedelta(minutes=1))  # minutes
    removed = swept.tasks + swept.names + swept.timers + swept.clusters
    metrics.add_metric("LeftoversRemoved", MetricUnit.Count, removed)
    metrics.add_metric("ServersOverdue", MetricUnit.Count, swept.overdue)
    metrics.add_metric("ServersLost", MetricUnit.Count, swept.lost)
    metrics.add_metric("SweepFailures", MetricUnit.Count, swept.failed)
    metrics.flush_metrics()
