"""Judges with ministack's evaluator of IAM policies whether a role allows an action.

The evaluator (`ministack/core/iam_evaluator.py`, 1.5.33) implements AWS's logic: an explicit deny refuses, else an
allow allows, else the action is refused. It imports only the standard library, so this process can load its file alone
from ministack's own virtual environment.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from testing import template as cfn
from testing.iam.actions import Ask

ROOT = Path(__file__).resolve().parents[2]
MISSING = (
    "ministack is not installed, so no role is judged: `make test` makes .venv-ministack; "
    "or set MINISTACK_VENV to an environment with it, or MINISTACK_SITE to its site-packages"
)


def evaluator_path() -> Path | None:
    """Return the path of the evaluator; None if ministack is not installed."""
    sites = [Path(os.environ["MINISTACK_SITE"])] if os.environ.get("MINISTACK_SITE") else []
    for venv in (os.environ.get("MINISTACK_VENV"), ROOT / ".venv-ministack"):
        sites += sorted(Path(venv).glob("lib/python3*/site-packages")) if venv else []
    found = (site / "ministack" / "core" / "iam_evaluator.py" for site in sites)
    return next((path for path in found if path.is_file()), None)


@cache
def evaluator() -> ModuleType | None:
    """Return the evaluator's module; None if ministack is not installed."""
    path = evaluator_path()
    if path is None:
        return None
    name = "ministack_iam_evaluator"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # its dataclasses look themselves up there
    spec.loader.exec_module(module)
    return module


class Judge:
    """Judges by the policies of the template's roles, with the references of one account.

    `principal` is always a function's name, or the logical id of a role or managed policy of the template.
    """

    def __init__(self, account: cfn.ReferenceValues) -> None:
        found = evaluator()
        assert found is not None, MISSING
        self._iam = found
        self._account = account
        self.functions = cfn.functions(account.of)
        self._policies: dict[str, list[Any]] = {}
        self._decided: dict[tuple[Any, ...], bool] = {}

    def may(self, principal: str, ask: Ask) -> bool:
        """Return whether the principal's policies allow this action on this resource."""
        question = (principal, ask.action, ask.resource, *sorted(map(str, ask.context.items())))
        if question not in self._decided:  # the same questions come thousands of times in a run
            self._decided[question] = self._decide(principal, ask)
        return self._decided[question]

    def _decide(self, principal: str, ask: Ask) -> bool:
        context = self._iam.EvalContext(
            principal_arn=f"arn:aws:sts::{self._account.id}:assumed-role/{principal}/session",
            principal_type="AssumedRole",
            principal_account=self._account.id,
            action=ask.action,
            resource_arn=ask.resource,
            region=self._account.region,
            secure_transport=True,
            service_context={key.lower(): value for key, value in ask.context.items()},
        )
        return bool(self._iam.evaluate(context, self.policies(principal)).decision == "Allow")

    def who_may(self, ask: Ask) -> frozenset[str]:
        """Return the names of the functions whose policies allow this action on this resource."""
        return frozenset(name for name in self.functions if self.may(name, ask))

    def policies(self, principal: str) -> list[Any]:
        """Return the parsed policies of the principal. Raises AssertionError if one is not valid."""
        if principal not in self._policies:
            documents = [self._account.resolve(document) for document in self._documents(principal)]
            problems = [self._iam.validate_policy_document(document) for document in documents]
            assert not any(problems), (principal, problems)
            self._policies[principal] = [self._iam.parse_policy_document(document) for document in documents]
        return self._policies[principal]

    def _documents(self, principal: str) -> Iterable[Mapping[str, Any]]:
        resources = self._account.of["Resources"]
        if principal in self.functions:
            role = resources[self.functions[principal]]["Properties"]["Role"]["Fn::GetAtt"][0]
            return cfn.role_documents(role, self._account.of)
        if resources[principal]["Type"] == "AWS::IAM::ManagedPolicy":
            return [resources[principal]["Properties"]["PolicyDocument"]]
        return cfn.role_documents(principal, self._account.of)
