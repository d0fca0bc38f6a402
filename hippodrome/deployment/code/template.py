"""Reads `infra/template.yml`, puts the keys of the built functions' zips into it, and evaluates its conditions."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml

from hippodrome import places
from hippodrome.console.problem import Problem
from hippodrome.deployment.aws import regions
from hippodrome.deployment.code.build import Function

PATH = places.ROOT / "infra" / "template.yml"

_CORRECT = "Correct infra/template.yml, or take it from the repository again."
_BUDGET = re.compile(r"^  Budget:\n(?:(?:   .*)?\n)*", re.MULTILINE)
_KEY = re.compile(r"(\bS3Key:\s*)([\"']?)([A-Za-z0-9_]+)\.zip\2(?=[\s,}]|$)")


class Template:
    """A CloudFormation template: its text and its content."""

    def __init__(self, text: str) -> None:
        self.text = text

    @classmethod
    def read(cls, path: Path = PATH) -> Template:
        """Read the project's template. Raises `Problem` if it cannot be read."""
        try:
            return cls(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise Problem(
                f"{path.name} cannot be read: {error.strerror}.",
                "Look at the file's permissions, or take it from the repository again.",
            ) from None

    def for_region(self, region: str) -> Template:
        """Return the template for this region: without the budget, if CloudFormation knows none there."""
        return Template(_BUDGET.sub("", self.text)) if region in regions.WITHOUT_BUDGETS else self

    def with_code(self, functions: Iterable[Function]) -> Template:
        """Replace each `<function>.zip` in the template by the key of its zip, and return the result.

        Raises `Problem` if one is missing.
        """
        keys = {function.name: function.key for function in functions}
        missing: set[str] = set()

        def key(match: re.Match[str]) -> str:
            if match[3] not in keys:
                missing.add(match[3])
            return f"{match[1]}{keys.get(match[3], match[3])}"

        text = _KEY.sub(key, self.text)
        if missing:
            raise Problem(
                f"The template names functions that lambdas/ does not have: {', '.join(sorted(missing))}.", _CORRECT
            )
        return Template(text)

    @property
    def functions(self) -> set[str]:
        """The functions whose zips the template names."""
        return {match[3] for match in _KEY.finditer(self.text)}

    @cached_property
    def body(self) -> Mapping[str, Any]:
        """The content: `!Ref x` as {"Ref": x}, `!GetAtt a.b` as {"Fn::GetAtt": ["a", "b"]}.

        Raises `Problem` if the text is not YAML, or has no Resources.
        """
        try:
            body = yaml.load(self.text, _Loader)  # noqa: S506 - a SafeLoader with CloudFormation's tags  # nosec B506
        except yaml.YAMLError as error:
            raise Problem(f"The template is not YAML: {error}.", _CORRECT) from None
        if not isinstance(body, dict) or "Resources" not in body:
            raise Problem("The template has no Resources.", _CORRECT)
        return body

    @property
    def defaults(self) -> dict[str, str | None]:
        """The parameters with their defaults; None if a parameter has no default."""
        return {
            name: str(spec["Default"]) if "Default" in spec else None
            for name, spec in self.body.get("Parameters", {}).items()
        }

    def refused(self, parameters: Mapping[str, str]) -> Iterator[tuple[str, str]]:
        """Yield the parameters whose values CloudFormation would refuse, each with what it must be.

        Ignores unknown names.
        """
        for name, spec in self.body.get("Parameters", {}).items():
            value = parameters.get(name, "")
            allowed = [str(allowed_value) for allowed_value in spec.get("AllowedValues", ())]
            if allowed and value not in allowed:
                yield name, f"must be one of {', '.join(allowed)}"
            elif "AllowedPattern" in spec and not re.fullmatch(spec["AllowedPattern"], value):
                yield name, spec.get("ConstraintDescription", f"must look like {spec['AllowedPattern']}")
            elif len(value) > int(spec.get("MaxLength", 4096)):
                yield name, f"must not be longer than {spec['MaxLength']}"

    def resources(self, parameters: Mapping[str, str]) -> dict[str, Mapping[str, Any]]:
        """Return the resources that exist with these parameters, by logical id."""
        conditions = self.body.get("Conditions", {})
        return {
            name: resource
            for name, resource in self.body["Resources"].items()
            if "Condition" not in resource
            or bool(_evaluate({"Condition": resource["Condition"]}, conditions, parameters))
        }

    def function_names(self) -> dict[str, str]:
        """Return, by logical id, the function's file name in `lambdas/`, which its handler names."""
        names = {}
        for name, resource in self.body["Resources"].items():
            handler = resource.get("Properties", {}).get("Handler")
            if isinstance(handler, str) and handler.startswith("lambdas."):
                names[name] = handler.split(".")[1]
        return names


def _evaluate(expression: Any, conditions: Mapping[str, Any], parameters: Mapping[str, str]) -> Any:
    """Evaluate an expression of the section Conditions."""
    if not isinstance(expression, dict) or len(expression) != 1:
        return expression
    ((name, value),) = expression.items()
    if name == "Ref":
        return parameters.get(value, "")
    if name == "Condition":
        return _evaluate(conditions.get(value), conditions, parameters)
    if name not in _FUNCTIONS:
        return expression
    return _FUNCTIONS[name](*(_evaluate(argument, conditions, parameters) for argument in value))


_FUNCTIONS: dict[str, Callable[..., bool]] = {
    "Fn::Not": lambda one: not one,
    "Fn::And": lambda *all_: all(all_),
    "Fn::Or": lambda *any_: any(any_),
    "Fn::Equals": lambda one, other: str(one) == str(other),
}


_Safe: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # ten times as fast where PyYAML has its C part


class _Loader(_Safe):  # type: ignore[misc]
    """YAML with CloudFormation's short tags."""


def _short_tag(loader: _Loader, suffix: str, node: yaml.Node) -> dict[str, Any]:
    if isinstance(node, yaml.ScalarNode):
        value: Any = loader.construct_scalar(node)
        if suffix == "GetAtt":
            value = str(value).split(".", 1)
    elif isinstance(node, yaml.SequenceNode):
        value = loader.construct_sequence(node, deep=True)
    else:
        assert isinstance(node, yaml.MappingNode)
        value = loader.construct_mapping(node, deep=True)
    return {suffix if suffix in {"Ref", "Condition"} else f"Fn::{suffix}": value}


_Loader.add_multi_constructor("!", _short_tag)
# AWSTemplateFormatVersion and the Version of a policy look like dates: they stay text.
_Loader.add_constructor("tag:yaml.org,2002:timestamp", lambda loader, node: str(node.value))
