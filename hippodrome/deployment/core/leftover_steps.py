"""The steps with which `stop`, `erase` and `destroy` remove what is left over of servers."""

from __future__ import annotations

from hippodrome.control.model import messages
from hippodrome.control.model.server import Reason
from hippodrome.control.ports import Platform
from hippodrome.control.servers.resources import Resources
from hippodrome.deployment.core.stages import PlanStep, step

STOP_REASON = f"{messages.STOP_REASON_PREFIX} {Reason.STOPPED}"


def removal_steps(platform: Platform, resources: Resources) -> list[PlanStep]:
    """Return the steps that stop the tasks, delete the DNS records with one change, and cancel the timers."""
    from hippodrome.control.servers.dns import delete_dns_records  # noqa: PLC0415 - imports Powertools, which other commands do without

    steps = [step(platform.tasks.stop, task.task, task.cluster, STOP_REASON) for task in resources.tasks]
    steps += [step(delete_dns_records, platform, resources.dns_records)] if resources.dns_records else []
    return steps + [step(platform.timers.cancel, timer) for timer in resources.timers]


def cluster_steps(platform: Platform, resources: Resources) -> list[PlanStep]:
    """Return the steps that delete the clusters. ECS refuses that while a task in the cluster is ending."""
    return [step(platform.tasks.delete_cluster, cluster) for cluster in resources.clusters]
