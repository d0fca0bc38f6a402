"""The template obeys every rule of `RULES`, and a template that breaks a rule is noticed."""

from __future__ import annotations

import copy
from typing import Any

import pytest

from testing import template as cfn
from tests.infra.rules import RULES, Rule, data
from tests.infra.rules.looked_up import LOOKED_UP
from tests.infra.situations import Installation, installations

INSTALLATIONS = list(installations())


def faults(rule: Rule, there: list[Installation]) -> list[str]:
    """Return the violations of a rule in these installations, each once."""
    return sorted({fault for one in there for fault in rule.faults(one)})


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_aws_accepts_the_template(rule: Rule) -> None:
    assert faults(rule, INSTALLATIONS) == [], f"{rule} ({rule.source})"


@pytest.mark.parametrize("rule", RULES, ids=str)
def test_a_template_that_breaks_the_rule_is_noticed(rule: Rule) -> None:
    spoiled: dict[str, Any] = copy.deepcopy(cfn.template())
    rule.spoil(spoiled)
    noticed = (fault for one in installations(spoiled) for fault in rule.faults(one))
    assert next(iter(noticed), None), f"nobody notices a template without: {rule}"


def test_each_rule_is_unique_and_has_a_source() -> None:
    names = [str(rule) for rule in RULES]
    assert sorted(names) == sorted(set(names))
    assert all(rule.accepts and len(rule.source) > 10 for rule in RULES)


def test_the_limits_of_every_property_of_the_template_were_looked_up() -> None:
    """A new type or property: find out what AWS accepts beyond the schema, write the rules, then add it to the table."""
    used: dict[str, set[str]] = {}
    for one in cfn.template()["Resources"].values():
        used.setdefault(one["Type"], set()).update(one.get("Properties", {}))
    new = {kind: sorted(names - LOOKED_UP.get(kind, set())) for kind, names in used.items()}
    assert {kind: names for kind, names in new.items() if names} == {}
    assert set(LOOKED_UP) == set(used), "types that are no more"


def test_every_type_of_the_template_has_a_rule() -> None:
    assert {one["Type"] for one in cfn.template()["Resources"].values()} <= {rule.kind for rule in RULES}


def test_every_condition_is_tried_both_ways() -> None:
    for name in cfn.template()["Conditions"]:
        assert {one.account.holds(name) for one in INSTALLATIONS} == {True, False}, name


def test_the_largest_and_the_least_numbers_are_tried() -> None:
    for name, parameter in cfn.template()["Parameters"].items():
        tried = {one.account.ref(name) for one in INSTALLATIONS}
        for limit in ("MinValue", "MaxValue"):
            assert limit not in parameter or parameter[limit] in tried, name


def test_the_retention_periods_of_logs_are_those_of_cloudwatch() -> None:
    assert set(cfn.template()["Parameters"]["LogRetentionDays"]["AllowedValues"]) <= set(data.RETENTION)


def test_the_longest_names_are_tried() -> None:
    sites = {str(one.account.resolve({"Fn::Sub": "${SiteHost}.${RootDomain}"})) for one in INSTALLATIONS}
    assert max(map(len, sites)) == 64
    assert {len(one.account.stack) for one in INSTALLATIONS} == {30, 1}
    parameters = cfn.template()["Parameters"]
    for name in ("RootDomain", "SiteHost", "ServersHost"):
        longest = max(len(str(one.account.ref(name))) for one in INSTALLATIONS)
        assert longest == parameters[name]["MaxLength"], name
