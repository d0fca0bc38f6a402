"""Whether a role may do a thing, as ministack's evaluator of IAM policies sees it.

The evaluator (`ministack/core/iam_evaluator.py`, 1.5.33) implements AWS's logic: explicit deny, allow, else no. It imports
only the standard library, so it is loaded from ministack's own environment into this process without the rest.
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
    """Where the evaluator lies; None if ministack is not there."""
    sites = [Path(os.environ["MINISTACK_SITE"])] if os.environ.get("MINISTACK_SITE") else []
    for venv in (os.environ.get("MINISTACK_VENV"), ROOT / ".venv-ministack"):
        sites += sorted(Path(venv).glob("lib/python3*/site-packages")) if venv else []
    found = (site / "ministack" / "core" / "iam_evaluator.py" for site in sites)
    return next((path for path in found if path.is_file()), None)


@cache
def evaluator() -> ModuleType | None:
    """ministack's evaluator; None if ministack is not there."""
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
    """Judges by the policies of the template's roles, resolved for one account."""

    def __init__(self, account: cfn.ReferenceValues) -> None:
        found = evaluator()
        assert found is not None, MISSING
        self._iam = found
        self._account = account
        self.functions = cfn.functions(account.of)
        self._policies: dict[str, list[Any]] = {}
        self._decided: dict[tuple[Any, ...], bool] = {}

    def may(self, who: str, ask: Ask) -> bool:
        """Whether the function, or else the role or managed policy of this logical id, allows it."""
        question = (who, ask.action, ask.resource, *sorted((key, str(value)) for key, value in ask.context.items()))
        if question not in self._decided:  # the same questions come thousands of times in a run
            self._decided[question] = self._decide(who, ask)
        return self._decided[question]

    def _decide(self, who: str, ask: Ask) -> bool:
        context = self._iam.EvalContext(
            principal_arn=f"arn:aws:sts::{self._account.id}:assumed-role/{who}/session",
            principal_type="AssumedRole",
            principal_account=self._account.id,
            action=ask.action,
            resource_arn=ask.resource,
            region=self._account.region,
            secure_transport=True,
            service_context={key.lower(): value for key, value in ask.context.items()},
        )
        return bool(self._iam.evaluate(context, self.policies(who)).decision == "Allow")

    def who_may(self, ask: Ask) -> frozenset[str]:
        """The functions that are allowed to do it."""
        return frozenset(name for name in self.functions if self.may(name, ask))

    def policies(self, who: str) -> list[Any]:
        if who not in self._policies:
            documents = [self._account.resolve(document) for document in self._documents(who)]
            problems = [self._iam.validate_policy_document(document) for document in documents]
            assert not any(problems), (who, problems)
            self._policies[who] = [self._iam.parse_policy_document(document) for document in documents]
        return self._policies[who]

    def _documents(self, who: str) -> Iterable[Mapping[str, Any]]:
        found = self._account.of["Resources"]
        if who in self.functions:
            role = found[self.functions[who]]["Properties"]["Role"]["Fn::GetAtt"][0]
            return cfn.role_documents(role, self._account.of)
        if found[who]["Type"] == "AWS::IAM::ManagedPolicy":
            return [found[who]["Properties"]["PolicyDocument"]]
        return cfn.role_documents(who, self._account.of)
