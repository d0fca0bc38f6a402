"""The concurrency of the functions behind queues leaves executions for pages, whatever the account allows."""

from __future__ import annotations

from typing import Any

import pytest
from botocore.exceptions import ClientError

from hippodrome.deployment.aws import concurrency
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.stack.settings import StackSettings

LEFT = {"HostedZoneId": "Z1", "RootDomain": "example.org", "ZoneA": "us-east-1a", "ZoneB": "us-east-1b"}


class Lambda(Account):
    """An account that answers only GetAccountSettings: with this many unreserved executions, or with an error."""

    def __init__(self, answer: int | ClientError) -> None:
        self._answer = answer

    def client(self, service: str, region: str | None = None) -> Any:
        assert service == "lambda"
        return self

    def get_account_settings(self) -> dict[str, Any]:
        if isinstance(self._answer, ClientError):
            raise self._answer
        return {"AccountLimit": {"ConcurrentExecutions": 1000, "UnreservedConcurrentExecutions": self._answer}}


REFUSED = ClientError({"Error": {"Code": "AccessDeniedException"}}, "GetAccountSettings")


def test_queues_take_at_most_half_of_the_executions_or_the_least_that_lambda_allows() -> None:
    least = 3 * concurrency.LEAST  # Lambda's MaximumConcurrency is at least 2, and there are three mappings
    for limit in range(8, 1001):
        assert concurrency.workers(limit) <= max(limit / 2, least), limit


def test_the_concurrency_of_new_and_usual_accounts() -> None:
    assert concurrency.parameters(10) == {"StartConcurrency": "2"}
    assert concurrency.parameters(50) == {"StartConcurrency": "20"}
    assert concurrency.parameters(1000) == {"StartConcurrency": Template.read().defaults["StartConcurrency"]}


def test_the_template_and_concurrency_py_agree_about_mappings() -> None:
    template = Template.read().body
    parameter = template["Parameters"]["StartConcurrency"]
    assert (parameter["MinValue"], parameter["MaxValue"]) == (2, 1000)
    scaling = {
        name: one["Properties"]["ScalingConfig"]["MaximumConcurrency"]
        for name, one in template["Resources"].items()
        if one["Type"] == "AWS::Lambda::EventSourceMapping"
    }
    assert scaling.pop("StartServerMapping") == {"Ref": concurrency.PARAMETER}
    assert sum(scaling.values()) == concurrency.OTHERS


@pytest.mark.parametrize(
    ("answer", "before", "chosen"),
    [
        pytest.param(10, {}, "2", id="a new account"),
        pytest.param(1000, {"StartConcurrency": "2"}, "20", id="AWS has raised the quota since the last time"),
        pytest.param(REFUSED, {}, "20", id="nobody tells: as the template has it"),
        pytest.param(REFUSED, {"StartConcurrency": "2"}, "2", id="nobody tells: as it was"),
    ],
)
def test_settings_choose_the_concurrency_by_unreserved_executions(
    answer: int | ClientError, before: dict[str, str], chosen: str
) -> None:
    found = StackSettings().parameters(Lambda(answer), Template.read().defaults, {**LEFT, **before}, "code")
    assert found["StartConcurrency"] == chosen
