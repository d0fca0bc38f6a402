"""Each deployed function stands in all the places that CONTRIBUTING.md names ("A new Lambda function")."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from hippodrome.local.backend.platform import HANDLERS as QUEUES_AND_TIMERS
from hippodrome.local.study import FUNCTIONS
from testing import template as cfn
from testing.iam.enforcement import WHO_MAY

ROOT = Path(__file__).resolve().parents[2]
SHARED = {"__init__"}
AWS_ONLY = {  # and why `make run` has none
    "sign_requests": "servers of one machine write into the data folder",
    "certify_server": "browsers connect to 127.0.0.1 without TLS",
    "renew_certificate": "browsers connect to 127.0.0.1 without TLS",
    "update_project_master_list": "`hippodrome/local/publish.py` registers the study itself",
}
HANDLERS = sorted(path.stem for path in (ROOT / "lambdas").glob("*.py") if path.stem not in SHARED)


ON_ONE_MACHINE = {
    *FUNCTIONS,
    *(handler.__module__.removeprefix("hippodrome.functions.") for handler in QUEUES_AND_TIMERS.values()),
}


def rows(page: str) -> set[str]:
    """Return what stands first in the rows of a page's tables."""
    return set(re.findall(r"^\| `(\w+)` \|", (ROOT / "docs" / page).read_text(encoding="utf-8"), re.MULTILINE))


def calls(role: str) -> set[str]:
    """Return the actions that a role allows, but for writing its own log."""
    statements = [
        one
        for document in cfn.ReferenceValues().resolve(cfn.role_documents(role))
        for one in document["Statement"]
        if one["Effect"] == "Allow"
    ]
    named = [one["Action"] for one in statements]
    actions = {action for one in named for action in ([one] if isinstance(one, str) else one)}
    return {action for action in actions if not action.startswith("logs:")}


@pytest.mark.parametrize("name", HANDLERS)
def test_a_function(name: str) -> None:
    properties = cfn.resources("AWS::Lambda::Function")
    assert name in cfn.functions(), "infra/template.yml has no function of this name"
    one = properties[cfn.functions()[name]]
    others = [other for logical, other in properties.items() if logical != cfn.functions()[name]]
    assert one["Role"] not in [other["Role"] for other in others], "its role is another function's too"
    group = cfn.resources("AWS::Logs::LogGroup")[one["LoggingConfig"]["LogGroup"]["Ref"]]
    assert group["LogGroupName"] == {"Fn::Sub": f"/hippodrome/${{AWS::StackName}}/{name}"}, "no log group of its name"
    alarms = [a for a in cfn.resources("AWS::CloudWatch::Alarm").values() if a.get("MetricName") == "Errors"]
    watched = [alarm["Dimensions"][0]["Value"]["Ref"] for alarm in alarms]
    assert cfn.functions()[name] in watched, "no alarm watches its errors"
    if calls(one["Role"]["Fn::GetAtt"][0]):
        assert any(name in may for may in WHO_MAY.values()), "testing/iam/enforcement.py: no call is allowed to it"
    assert (name in ON_ONE_MACHINE) != (name in AWS_ONLY), (
        "hippodrome/local/ has no such function, and AWS_ONLY does not say why"
    )
    assert name in rows("functions.md"), "docs/functions.md has no row for it"
    assert name in rows("permissions.md"), "docs/permissions.md has no row for it: python -m tests.infra.table"
    written = ast.parse((ROOT / "hippodrome" / "functions" / f"{name}.py").read_text(encoding="utf-8"))
    handler = next(one for one in written.body if isinstance(one, ast.FunctionDef) and one.name == "handler")
    assert ast.get_docstring(handler), "its handler does not say what goes in and what comes out"


def test_every_list_names_exactly_the_deployed_functions() -> None:
    assert set(cfn.functions()) == rows("permissions.md") == set(HANDLERS)
    assert set.union(*WHO_MAY.values()) <= set(HANDLERS)
