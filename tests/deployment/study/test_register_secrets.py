"""`register` of a study with a language model: its servers get the model's key, and no other study's do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hippodrome.console.problem import Exit
from testing.aws_events import ACCOUNT
from tests.deployment.registering import Register, RegisterWorld, configure

TALKS = ("trial:\n", "trial:\n  llm: {url: https://models.example.org/v1, model: small}\n")
"""A change of the study's config.yml (`configure`)."""


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
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    configure(folder, TALKS)
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
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    store_key(register_world)
    register(code=Exit.DONE)
    assert secrets(register_world) == []
    configure(folder, TALKS)
    register(code=Exit.DONE)
    arn = f"arn:aws:ssm:us-east-1:{ACCOUNT}:parameter/hippodrome/hippodrome/LLM_KEY"
    assert secrets(register_world) == [{"name": "LLM_KEY", "valueFrom": arn}]
    assert "Nothing to do" in register("--dry-run").out
    configure(folder)
    register(code=Exit.DONE)
    assert secrets(register_world) == [], "a study that has no model any more gives its servers no key"


def test_a_model_of_one_game_alone_needs_the_key_too(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    steps = (
        "steps:\n    - consent\n    - chat: {llm: {url: https://models.example.org/v1, model: small}}\n    - thanks\n"
    )
    configure(folder, ("steps: {1: consent, 2: game, 3: thanks}\n", steps))
    assert "has no LLM_KEY" in register(code=Exit.FAILED).err
    store_key(register_world)
    register(code=Exit.DONE)
    assert [one["name"] for one in secrets(register_world)] == ["LLM_KEY"]
