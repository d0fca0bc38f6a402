"""`register` of a study with a language model: its servers get the model's key, and no other study's do."""

from __future__ import annotations

from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.model.project import Project
from testing.aws_events import ACCOUNT
from tests.deployment.registering import Register, RegisterWorld


@pytest.fixture
def with_llm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Project, "uses_llm", property(lambda self: True))


def store_key(register_world: RegisterWorld) -> None:
    register_world.client("ssm").put_parameter(
        Name="/hippodrome/hippodrome/LLM_KEY", Value="sk-secret", Type="SecureString"
    )


def secrets(register_world: RegisterWorld) -> list[dict[str, Any]]:
    revision = register_world.project().task_definition
    found = register_world.client("ecs").describe_task_definition(taskDefinition=revision)["taskDefinition"]
    (container,) = found["containerDefinitions"]
    assert "sk-secret" not in repr(found)
    return list(container.get("secrets") or [])


def test_without_the_key_a_study_with_a_language_model_is_refused(
    register_world: RegisterWorld, register: Register, with_llm: None
) -> None:
    refused = register(code=Exit.FAILED)
    assert "The study has trial.llm, and the installation hippodrome has no LLM_KEY: no server could start." in (
        refused.err
    )
    assert "hippodrome secret set LLM_KEY" in refused.err
    assert register_world.project() is None
    assert not register_world.keys("maze/")
    store_key(register_world)
    register(code=Exit.DONE)


def test_servers_of_a_study_with_a_language_model_get_the_key_from_the_parameter(
    register_world: RegisterWorld, register: Register, monkeypatch: pytest.MonkeyPatch
) -> None:
    store_key(register_world)
    register(code=Exit.DONE)
    assert secrets(register_world) == []
    with monkeypatch.context() as patched:
        patched.setattr(Project, "uses_llm", property(lambda self: True))
        register(code=Exit.DONE)
        arn = f"arn:aws:ssm:us-east-1:{ACCOUNT}:parameter/hippodrome/hippodrome/LLM_KEY"
        assert secrets(register_world) == [{"name": "LLM_KEY", "valueFrom": arn}]
        assert "Nothing to do" in register("--dry-run").out
    register(code=Exit.DONE)
    assert secrets(register_world) == [], "a study that has no model any more gives its servers no key"
