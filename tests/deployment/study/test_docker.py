"""Images that Docker builds on this machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.study.image import docker
from hippodrome.deployment.study.image.bundle import make_bundle
from tests.deployment.registering import Register, RegisterWorld, docker_calls, fake_docker


def test_docker_builds_where_it_runs(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.docker = fake_docker(tmp_path / "bin")
    monkeypatch.setenv("PATH", str(register_world.docker))
    register_world.put_image("maze-aaaaaaaaaaaa")
    register(code=Exit.DONE)
    assert register_world.builds == []
    calls = docker_calls(register_world.docker)
    login = next(call for call in calls if call["words"][0] == "login")
    assert login["words"][-1] == register_world.repository.partition("/")[0]
    assert login["stdin"]
    assert not any(login["stdin"] in word for call in calls for word in call["words"])
    build = calls[-1]["words"]
    assert build[build.index("--platform") + 1] == "linux/amd64"
    assert build[build.index("--cache-from") + 1] == f"type=registry,ref={register_world.repository}:maze-aaaaaaaaaaaa"
    assert "--push" in build
    assert {"Dockerfile", "hippodrome/trial/__main__.py", "project/agent.py", "requirements/project.txt"} <= set(
        calls[-1]["files"]
    )
    register(code=Exit.DONE)
    assert docker_calls(register_world.docker) == calls  # the image is not built twice


def test_build_on_aws_does_not_use_docker(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.docker = fake_docker(tmp_path / "bin")
    monkeypatch.setenv("PATH", str(register_world.docker))
    register("--build-on-aws", code=Exit.DONE)
    assert len(register_world.builds) == 1
    assert docker_calls(register_world.docker) == []


def test_a_failure_of_docker_is_reported(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.docker = fake_docker(
        tmp_path / "bin", build=1, says="#7 ERROR: No matching distribution found for nosuch"
    )
    monkeypatch.setenv("PATH", str(register_world.docker))
    ran = register(code=Exit.FAILED)
    assert "requirements.txt asks for nosuch" in ran.err
    assert register_world.project() is None


@pytest.mark.parametrize("there", [{"engine": False}, {"buildx": False}])
def test_docker_without_an_engine_or_buildx_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: dict[str, bool]
) -> None:
    monkeypatch.setenv("PATH", str(fake_docker(tmp_path / "bin", **there)))
    assert not docker.available()


def test_a_machine_without_docker_is_recognized(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not docker.available()


def test_another_mirror_of_the_base_makes_another_image(tmp_path: Path) -> None:
    usual, mirrored = make_bundle(tmp_path), make_bundle(tmp_path, "mirror.example/python:3.13-slim")
    assert usual.hash != mirrored.hash
    assert b"\nARG BASE=mirror.example/python:3.13-slim\n" in mirrored.entries["Dockerfile"]
    with pytest.raises(Problem, match="no name of an image"):
        make_bundle(tmp_path, "x\nRUN evil")
