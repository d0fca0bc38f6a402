"""Rules for alarms, the dashboard and the budget."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from testing.template import listed
from tests.infra.rules.book import Rule, Template, each, first, number, one_of, setting, text
from tests.infra.situations import Installation, Resource

ALARM, DASHBOARD, BUDGET = "AWS::CloudWatch::Alarm", "AWS::CloudWatch::Dashboard", "AWS::Budgets::Budget"
PUT_ALARM = "CloudWatch API Reference, PutMetricAlarm"
BODY = "CloudWatch API Reference, Dashboard Body Structure and Syntax"


def _periods(one: Resource, there: Installation) -> Iterator[str]:
    period, count = one.properties["Period"], one.properties["EvaluationPeriods"]
    if period not in (10, 20, 30) and period % 60:
        yield f"a period of {period} s"
    if period * count > (604_800 if period >= 3600 else 86_400):
        yield f"it looks back {period * count} s"


def _datapoints(one: Resource, there: Installation) -> Iterator[str]:
    if not 1 <= one.properties.get("DatapointsToAlarm", 1) <= one.properties["EvaluationPeriods"]:
        yield "it wants more data points than it looks at"


def _actions(one: Resource, there: Installation) -> Iterator[str]:
    if len(one.properties.get("AlarmActions", [])) > 5:
        yield "more than 5 actions"
    if len(one.properties.get("Dimensions", [])) > 30:
        yield "more than 30 dimensions"
    for dimension in one.properties.get("Dimensions", []):
        if not re.fullmatch(r"(?!:)[\x20-\x7e]{1,255}", dimension["Name"]) or not 1 <= len(dimension["Value"]) <= 1024:
            yield f"the dimension {dimension['Name']}"


def _unheard(there: Installation) -> Iterator[str]:
    """A topic with a policy of its own takes messages of the services that this policy names, and of no other."""
    senders = {"cloudwatch.amazonaws.com": there.of(ALARM), "budgets.amazonaws.com": there.of(BUDGET)}
    for policy in there.of("AWS::SNS::TopicPolicy"):
        statements = policy.properties["PolicyDocument"]["Statement"]
        named = {name for one in statements for name in listed(one["Principal"].get("Service", []))}
        for topic in policy.properties["Topics"]:
            for service, resources in senders.items():
                if service not in named and any(topic in json.dumps(dict(one.properties)) for one in resources):
                    yield f"{service} may not publish to {topic}"


def _body(one: Resource) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(one.properties["DashboardBody"])
    return found


def _no_dashboard(one: Resource, there: Installation) -> Iterator[str]:
    try:
        widgets = _body(one)["widgets"]
    except (ValueError, KeyError):
        yield "its body is not JSON with widgets"
        return
    if len(widgets) > 500 or sum(len(w["properties"].get("metrics", ())) for w in widgets) > 2500:
        yield "more than 500 widgets or 2,500 metrics"
    for widget in widgets:
        if widget["x"] + widget["width"] > 24 or not 1 <= widget["height"] <= 1000:
            yield f"{widget['properties']['title']} does not fit into 24 columns"
        if widget["type"] == "metric" and not {"region", "metrics", "title"} <= set(widget["properties"]):
            yield f"{widget['properties'].get('title')} has no region or metrics"
        if len(widget["properties"].get("alarms", ())) > 100:
            yield f"{widget['properties']['title']} has more than 100 alarms"


def _forgotten(one: Resource, there: Installation) -> Iterator[str]:
    shown = {arn for widget in _body(one)["widgets"] for arn in widget["properties"].get("alarms", ())}
    arns = {there.account.attribute(alarm.name, "Arn") for alarm in there.of(ALARM)}
    yield from (f"it shows {arn}, which is no alarm" for arn in sorted(shown - arns))


def _named(one: Resource, there: Installation) -> Iterator[str]:
    name = one.properties["Budget"].get("BudgetName")
    if name is not None and (len(name) > 100 or re.search(r"[:\\]|/action/", name)):
        yield f"it is called {name}"


def _notified(one: Resource, there: Installation) -> Iterator[str]:
    notifications = one.properties.get("NotificationsWithSubscribers", [])
    if len(notifications) > 10:
        yield "more than 10 notifications"
    kinds = [json.dumps(found["Notification"], sort_keys=True) for found in notifications]
    if len(kinds) != len(set(kinds)):
        yield "one notification twice"
    for found in notifications:
        sent = [subscriber["SubscriptionType"] for subscriber in found["Subscribers"]]
        if sent.count("SNS") > 1 or sent.count("EMAIL") > 10 or not sent:
            yield "more than one topic, or than ten addresses"


def _amount(one: Resource, there: Installation) -> Iterator[str]:
    limit = one.properties["Budget"].get("BudgetLimit", {})
    if not re.fullmatch(r"([0-9]*\.)?[0-9]+", str(limit.get("Amount", 1))) or float(limit.get("Amount", 1)) <= 0:
        yield f"{limit.get('Amount')} is no amount"


def _late(one: Resource, there: Installation) -> Iterator[str]:
    if not any(policy.name in there.waits_for(one.name) for policy in there.of("AWS::SNS::TopicPolicy")):
        yield "it does not wait for the policy of its topic"


def _dashboard(change: Any) -> Any:
    def spoil(template: Template) -> None:
        body = first(template, DASHBOARD)["DashboardBody"]
        body["Fn::Sub"] = change(body["Fn::Sub"])

    return spoil


def _quiet(template: Template) -> None:
    template["Resources"]["AlarmsPolicy"]["Properties"]["PolicyDocument"]["Statement"][0]["Principal"] = {
        "Service": "cloudwatch.amazonaws.com"
    }


def _twice(template: Template) -> None:
    first(template, BUDGET)["NotificationsWithSubscribers"] *= 2


RULES: tuple[Rule, ...] = (
    *text(ALARM, "AlarmName", PUT_ALARM, most=255),
    *text(ALARM, "AlarmDescription", PUT_ALARM, most=1024),
    *text(ALARM, "Namespace", PUT_ALARM, most=255, pattern=r"[^:].*", spoiled=":Hippodrome"),
    *text(ALARM, "MetricName", PUT_ALARM, most=255),
    one_of(ALARM, "Statistic", PUT_ALARM, ("SampleCount", "Average", "Sum", "Minimum", "Maximum")),
    one_of(ALARM, "TreatMissingData", PUT_ALARM, ("breaching", "notBreaching", "ignore", "missing")),
    each(
        ALARM,
        "Period",
        "10, 20, 30 or minutes; together at most a day, or a week from an hour on",
        PUT_ALARM,
        _periods,
        setting(ALARM, "Period", 90),
    ),
    each(
        ALARM,
        "DatapointsToAlarm",
        "no more than EvaluationPeriods",
        PUT_ALARM,
        _datapoints,
        setting(ALARM, "DatapointsToAlarm", 2),
    ),
    each(
        ALARM,
        "Dimensions",
        "at most 30, names of ASCII; at most 5 actions",
        f"{PUT_ALARM}; CloudWatch API Reference, Dimension",
        _actions,
        setting(ALARM, "Dimensions.*.Name", "Größe"),
    ),
    Rule(
        ALARM,
        "AlarmActions",
        "a topic whose policy lets CloudWatch, and Budgets, publish",
        "SNS Developer Guide, Example cases for access control; AWS Budgets, Creating an Amazon SNS topic for notifications",
        _unheard,
        _quiet,
    ),
    *text(
        DASHBOARD,
        "DashboardName",
        "CloudWatch API Reference, PutDashboard",
        most=255,
        pattern=r"[A-Za-z0-9_-]+",
        spoiled="the dashboard",
    ),
    each(
        DASHBOARD,
        "DashboardBody",
        "JSON of at most 500 widgets in 24 columns, 2,500 metrics, a region for each metric widget, 100 alarms for each",
        f"{BODY}; CloudWatch User Guide, CloudWatch service quotas",
        _no_dashboard,
        _dashboard(lambda body: body.replace('"x": 16', '"x": 17')),
    ),
    each(
        DASHBOARD,
        "DashboardBody",
        "alarms that there are",
        BODY,
        _forgotten,
        _dashboard(lambda body: body.replace("${SweepErrorsAlarm.Arn}", "${Sweep.Arn}")),
    ),
    each(
        BUDGET,
        "Budget.BudgetName",
        "at most 100 characters, without : and \\ and /action/",
        "AWS Budgets API Reference, Budget",
        _named,
        setting(BUDGET, "Budget.BudgetName", "a:b"),
    ),
    each(
        BUDGET,
        "NotificationsWithSubscribers",
        "at most 10, each once, each to one topic and ten addresses",
        'AWS Budgets API Reference, CreateBudget; "one notification can only have 1 subscribers with type of SNS" '
        "(aprin-labs/archimedes 1712)",
        _notified,
        _twice,
    ),
    number(
        BUDGET,
        "NotificationsWithSubscribers.*.Notification.Threshold",
        "AWS Budgets API Reference, Notification",
        0,
        15_000_000_000_000,
    ),
    each(
        BUDGET,
        "Budget.BudgetLimit",
        "a number above zero",
        "AWS Budgets API Reference, Spend",
        _amount,
        setting(BUDGET, "Budget.BudgetLimit.Amount", "fifty"),
    ),
    each(
        BUDGET,
        "DependsOn",
        "only after the policy of the topic that it sends to",
        "AWS Budgets, Creating an Amazon SNS topic for budget notifications",
        _late,
        lambda t: t["Resources"]["Budget"].pop("DependsOn"),
    ),
)
