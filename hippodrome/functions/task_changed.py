"""ECS Task State Change → queue: gives running tasks a DNS record; cleans up after ended tasks and replaces servers."""

from typing import Any

from hippodrome.control.model import messages
from hippodrome.control.servers.dns import DnsRecords
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.termination import ENDED, Termination
from hippodrome.functions import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.BatchResponse:
    """Handle an SQS batch of ECS events and of messages that the function has sent to itself.

    Returns the partial batch response with the messages that SQS must deliver again.
    """
    found = queue.read(event, lambda body: messages.parse_dns_changed(body) or messages.parse_task_changed(body))
    services = installed.shared(ServerServices)
    dns = DnsRecords(services)
    follow_ups = [(i, m) for i, m in found if isinstance(m, messages.DnsChanged)]
    events = [(i, m) for i, m in found if isinstance(m, messages.TaskChanged)]
    failed = queue.all_at_once(follow_ups, dns.dns_changed)
    failed += queue.all_at_once([(i, m) for i, m in events if m.status == "RUNNING"], dns.tasks_running)
    failed += queue.all_at_once([(i, m) for i, m in events if m.status in ENDED], Termination(services).tasks_ended)
    queue.report_failures(services)
    return queue.response(event, failed)
