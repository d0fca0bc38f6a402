"""Rules for topics, queues, events and timers."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from testing.template import listed
from tests.infra.rules.book import Rule, Spoil, Template, each, first, number, put, setting, text
from tests.infra.situations import Installation, Resource

QUEUE, QUEUE_POLICY = "AWS::SQS::Queue", "AWS::SQS::QueuePolicy"
TOPIC, TOPIC_POLICY, SUBSCRIPTION = "AWS::SNS::Topic", "AWS::SNS::TopicPolicy", "AWS::SNS::Subscription"
EVENTS, GROUP = "AWS::Events::Rule", "AWS::Scheduler::ScheduleGroup"

CREATE_QUEUE = "SQS API Reference, CreateQueue"
SPECIAL = (
    'SQS Developer Guide, "Special Information for SQS Policies" (AccessPolicyLanguage_SpecialInfo): "Each policy must '
    'cover only a single queue", 8,192 bytes, 20 statements, 50 principals, 10 conditions'
)


def _statements(one: Resource) -> list[dict[str, Any]]:
    return list(one.properties["PolicyDocument"]["Statement"])


def _more_than_one_queue(one: Resource, there: Installation) -> Iterator[str]:
    if len(one.properties["Queues"]) != 1:
        yield f"it is the policy of {len(one.properties['Queues'])} queues"
    (queue, *_) = one.properties["Queues"]
    arns = {other.name: there.account.attribute(other.name, "Arn") for other in there.of(QUEUE)}
    own = next((arns[other.name] for other in there.of(QUEUE) if there.account.ref(other.name) == queue), None)
    for statement in _statements(one):
        if listed(statement["Resource"]) != [own]:
            yield f"a statement covers {statement['Resource']}"


def _policies_of_a_queue(there: Installation) -> Iterator[str]:
    queues = [queue for one in there.of(QUEUE_POLICY) for queue in one.properties["Queues"]]
    yield from (
        f"{queue} has {queues.count(queue)} policies" for queue in sorted(set(queues)) if queues.count(queue) > 1
    )


def _too_much(one: Resource, there: Installation) -> Iterator[str]:
    document = one.properties["PolicyDocument"]
    if len(json.dumps(document, separators=(",", ":")).encode()) > 8192:
        yield "more than 8,192 bytes"
    if len(document["Statement"]) > 20:
        yield "more than 20 statements"
    for statement in document["Statement"]:
        if len(listed(statement["Action"])) > 7:
            yield "more than 7 actions"


def _not_its_own(one: Resource, there: Installation) -> Iterator[str]:
    for statement in _statements(one):
        if any(not re.fullmatch(r"(?i)sns:[a-z]+", action) for action in listed(statement["Action"])):
            yield f"{statement['Action']} is none of a topic's actions"
        if set(listed(statement["Resource"])) - set(one.properties["Topics"]):
            yield f"{statement['Resource']} is not its topic"
    if len(json.dumps(one.properties["PolicyDocument"]).encode()) > 30_720:
        yield "more than 30 KB"


def _unready(one: Resource, there: Installation) -> Iterator[str]:
    """What sends to a queue waits for that queue's policy."""
    policies = {queue: policy.name for policy in there.of(QUEUE_POLICY) for queue in _queues_of(policy)}
    wanted = {name for name in _reached(one.raw["Properties"]) if there.everything[name].kind == QUEUE}
    for queue in sorted(wanted):
        if policies.get(queue) not in there.waits_for(one.name):
            yield f"it does not wait for the policy of {queue}"


def _turned_away(one: Resource, there: Installation) -> Iterator[str]:
    """What sends to a queue comes with its own ARN (a subscription with its topic's), which the policy has to name."""
    service, sender = (
        ("sns.amazonaws.com", one.properties["TopicArn"])
        if one.kind == SUBSCRIPTION
        else ("events.amazonaws.com", there.account.attribute(one.name, "Arn"))
    )
    policies = {queue: policy for policy in there.of(QUEUE_POLICY) for queue in _queues_of(policy)}
    for queue in sorted(name for name in _reached(one.raw["Properties"]) if there.everything[name].kind == QUEUE):
        wanted = {
            "Effect": "Allow",
            "Principal": {"Service": service},
            "Action": "sqs:SendMessage",
            "Resource": there.account.attribute(queue, "Arn"),
            "Condition": {"ArnEquals": {"aws:SourceArn": sender}},
        }
        if queue not in policies or wanted not in _statements(policies[queue]):
            yield f"{queue} takes nothing from {sender}"


def _queues_of(policy: Resource) -> list[str]:
    return [queue["Ref"] for queue in policy.raw["Properties"]["Queues"]]


def _reached(value: Any) -> Iterator[str]:
    """The logical ids whose ARN a value holds as GetAtt."""
    if isinstance(value, list):
        for item in value:
            yield from _reached(item)
    elif isinstance(value, dict):
        if "Fn::GetAtt" in value:
            yield value["Fn::GetAtt"][0]
        else:
            for item in value.values():
                yield from _reached(item)


def _sent_raw(one: Resource, there: Installation) -> Iterator[str]:
    if one.properties.get("RawMessageDelivery") and one.properties["Protocol"] not in {
        "sqs",
        "http",
        "https",
        "firehose",
    }:
        yield f"raw messages by {one.properties['Protocol']}"


def _other_kind(one: Resource, there: Installation) -> Iterator[str]:
    arn = one.properties.get("RedrivePolicy", {}).get("deadLetterTargetArn")
    if arn is not None:
        target = next((other for other in there.of(QUEUE) if there.account.attribute(other.name, "Arn") == arn), None)
        if target is None or bool(target.properties.get("FifoQueue")) != bool(one.properties.get("FifoQueue")):
            yield "its dead letters go to no queue of its own kind"


def _patterns(one: Resource, there: Installation) -> Iterator[str]:
    pattern = one.properties.get("EventPattern")
    if pattern is not None and len(json.dumps(pattern, separators=(",", ":"))) > 2048:
        yield "its pattern has more than 2,048 characters"


def _targets(one: Resource, there: Installation) -> Iterator[str]:
    targets = one.properties.get("Targets", [])
    if len(targets) > 5:
        yield f"{len(targets)} targets"
    if len({target["Id"] for target in targets}) != len(targets):
        yield "two targets with one id"
    if ("EventPattern" in one.properties) == ("ScheduleExpression" in one.properties):
        yield "it has not exactly one of a pattern and a time"


def _rates(one: Resource, there: Installation) -> Iterator[str]:
    said = one.properties.get("ScheduleExpression")
    if said is None:
        return
    found = re.fullmatch(r"rate\(([1-9][0-9]*) (minute|hour|day)(s?)\)", said)
    if not found or (found[1] == "1") == bool(found[3]):
        yield f"{said}: one minute, two minutes"


def _many_targets(template: Template) -> None:
    target = first(template, EVENTS)["Targets"][0]
    first(template, EVENTS)["Targets"] = [dict(target, Id=str(number)) for number in range(6)]


def _for_another(name: str) -> Spoil:
    def spoil(template: Template) -> None:
        statement = template["Resources"][name]["Properties"]["PolicyDocument"]["Statement"][0]
        statement["Condition"]["ArnEquals"]["aws:SourceArn"] = {"Ref": "StartServerTopic"}

    return spoil


def _two_queues(template: Template) -> None:
    policy = template["Resources"]["StartQueuePolicy"]["Properties"]
    statement = policy["PolicyDocument"]["Statement"][0]
    arns = [{"Fn::GetAtt": [name, "Arn"]} for name in ("StartQueue", "StartDeadLetters")]
    policy["Queues"] = [{"Ref": "StartQueue"}, {"Ref": "StartDeadLetters"}]
    statement["Resource"] = arns


def _long_policy(template: Template) -> None:
    statements = first(template, QUEUE_POLICY)["PolicyDocument"]["Statement"]
    statements += statements * 20


def _scheduled(template: Template) -> None:
    rule = next(one for one in template["Resources"].values() if "ScheduleExpression" in one.get("Properties", {}))
    rule["Properties"]["ScheduleExpression"] = "rate(1 days)"


def _without(name: str) -> Any:
    def spoil(template: Template) -> None:
        depends = template["Resources"][name]["DependsOn"]
        template["Resources"][name]["DependsOn"] = [one for one in depends if not one.endswith("DeadLettersPolicy")]

    return spoil


def _no_sns(template: Template) -> None:
    first(template, TOPIC_POLICY)["PolicyDocument"]["Statement"][0]["Action"] = "sns:*"


_NAME = r"[A-Za-z0-9_-]+"

RULES = (
    *text(QUEUE, "QueueName", CREATE_QUEUE, most=80, pattern=_NAME, spoiled="start.queue"),
    number(QUEUE, "VisibilityTimeout", CREATE_QUEUE, 0, 43_200),
    number(QUEUE, "MessageRetentionPeriod", CREATE_QUEUE, 60, 1_209_600),
    number(QUEUE, "RedrivePolicy.maxReceiveCount", "SQS Developer Guide, Dead-letter queues", 1, 1000),
    each(
        QUEUE,
        "RedrivePolicy.deadLetterTargetArn",
        "a queue of the same kind",
        CREATE_QUEUE,
        _other_kind,
        setting(QUEUE, "RedrivePolicy.deadLetterTargetArn", {"Fn::GetAtt": ["StartServerTopic", "Arn"]}),
    ),
    each(
        QUEUE_POLICY,
        "PolicyDocument",
        "one queue and its one ARN",
        f"{SPECIAL}; remind101/stacker_blueprints pull request 71",
        _more_than_one_queue,
        _two_queues,
    ),
    Rule(
        QUEUE_POLICY,
        "Queues",
        "one policy for a queue: the later one takes the place of the earlier",
        "SQS API Reference, SetQueueAttributes; hashicorp/terraform 12003",
        _policies_of_a_queue,
        lambda t: t["Resources"].update(Second=t["Resources"]["StartQueuePolicy"]),
    ),
    each(
        QUEUE_POLICY,
        "PolicyDocument",
        "at most 8,192 bytes, 20 statements, 7 actions in each",
        f"{SPECIAL}; terraform-provider-aws 202",
        _too_much,
        _long_policy,
    ),
    *text(TOPIC, "TopicName", "SNS API Reference, CreateTopic", most=256, pattern=_NAME, spoiled="start server"),
    *text(TOPIC, "DisplayName", "SNS API Reference, SetTopicAttributes: up to 100 characters", most=100),
    each(
        TOPIC_POLICY,
        "PolicyDocument",
        "actions of SNS without a star, on its own topic, 30 KB",
        'SNS API Reference, AddPermission; "Invalid parameter: Policy Error" (serverless-application-model 1591)',
        _not_its_own,
        _no_sns,
    ),
    *(
        each(
            kind,
            "DependsOn",
            "only after the policies of the queues that it sends to, dead letters included",
            source,
            _unready,
            _without(name),
        )
        for kind, name, source in (
            (
                SUBSCRIPTION,
                "StartSubscription",
                "SNS Developer Guide, Fanout to SQS queues: permission before messages",
            ),
            (EVENTS, "TaskRule", "EventBridge User Guide, Dead-letter queues: granting permissions to the queue"),
        )
    ),
    *(
        each(
            kind,
            "Endpoint" if kind == SUBSCRIPTION else "Targets",
            "only queues whose policy lets it in by its ARN, dead letters included",
            source,
            _turned_away,
            _for_another(name),
        )
        for kind, name, source in (
            (SUBSCRIPTION, "StopQueuePolicy", "SNS Developer Guide, Subscribing an SQS queue: permission to the topic"),
            (
                EVENTS,
                "TaskDeadLettersPolicy",
                "EventBridge User Guide, Resource-based policies: SQS, and dead-letter queues",
            ),
        )
    ),
    each(
        SUBSCRIPTION,
        "RawMessageDelivery",
        "with sqs, http(s) and firehose only",
        "SNS API Reference, SetSubscriptionAttributes",
        _sent_raw,
        setting(SUBSCRIPTION, "Protocol", "email"),
    ),
    *text(
        EVENTS, "Name", "EventBridge API Reference, PutRule", most=64, pattern=r"[.\-_A-Za-z0-9]+", spoiled="to sweep"
    ),
    *text(EVENTS, "Description", "EventBridge API Reference, PutRule", most=512),
    *text(
        EVENTS, "Targets.*.Id", "EventBridge API Reference, Target", most=64, pattern=r"[.\-_A-Za-z0-9]+", spoiled="a b"
    ),
    each(
        EVENTS,
        "EventPattern",
        "at most 2,048 characters",
        "EventBridge User Guide, Quotas: event pattern size",
        _patterns,
        lambda t: put(first(t, EVENTS), "EventPattern.detail.group", ["x" * 2048]),
    ),
    each(
        EVENTS,
        "Targets",
        "at most 5, each with an id of its own",
        "EventBridge User Guide, Quotas",
        _targets,
        _many_targets,
    ),
    each(
        EVENTS,
        "ScheduleExpression",
        "rate(1 minute), rate(2 minutes): one and many",
        "EventBridge User Guide, Rate expressions: the unit is singular with 1 and plural otherwise",
        _rates,
        _scheduled,
    ),
    *text(
        GROUP,
        "Name",
        "EventBridge Scheduler API Reference, CreateScheduleGroup; every account has a group default",
        most=64,
        pattern=r"(?!default$)[0-9a-zA-Z\-_.]+",
        spoiled="default",
        accepts="a name of 0-9a-zA-Z-_. that is not default",
    ),
)
