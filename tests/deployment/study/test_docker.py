"""Images that this machine's Docker, Podman or Buildah builds by the Dockerfile."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.study.image.builders import BUILDERS
from hippodrome.deployment.study.image.bundle import make_bundle
from tests.deployment.registering import Register, RegisterWorld, docker_calls, fake_docker


def test_docker_builds_and_pushes(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.docker = fake_docker(tmp_path / "bin")
    monkeypatch.setenv("PATH", str(register_world.docker))
    register("--docker", code=Exit.DONE)
    assert register_world.builds == []
    calls = docker_calls(register_world.docker)
    login = next(call for call in calls if call["words"][0] == "login")
    assert login["words"][-1] == register_world.repository.partition("/")[0]
    assert login["stdin"]
    assert not any(login["stdin"] in word for call in calls for word in call["words"])
    build = calls[-1]["words"]
    assert build[build.index("--platform") + 1] == "linux/amd64"
    assert "--push" in build
    assert {"Dockerfile", "hippodrome/trial/__main__.py", "project/agent.py", "requirements/project.txt"} <= set(
        calls[-1]["files"]
    )
    register("--docker", code=Exit.DONE)
    assert docker_calls(register_world.docker) == calls  # the image is not built twice


def test_docker_is_not_used_unless_it_is_asked_for(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.docker = fake_docker(tmp_path / "bin")
    monkeypatch.setenv("PATH", str(register_world.docker))
    register(code=Exit.DONE)
    assert len(register_world.builds) == 1
    assert docker_calls(register_world.docker) == []


@pytest.mark.parametrize("program", ["podman", "buildah"])
def test_podman_or_buildah_builds_in_layers_where_docker_is_missing(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register, program: str
) -> None:
    register_world.docker = fake_docker(tmp_path / "bin", program=program)
    monkeypatch.setenv("PATH", str(register_world.docker))
    register("--docker", "--rebuild", code=Exit.DONE)
    login, build, push = (call["words"] for call in docker_calls(register_world.docker))
    assert login[:2] == ["login", "--username"]
    assert {"--layers", "--no-cache"} <= set(build), "or a changed agent.py would be sent with all packages"
    (tag,) = register_world.image_tags()
    assert push == ["push", f"{register_world.repository}:{tag}"]


def test_a_machine_without_any_of_them_is_told(register: Register) -> None:
    ran = register("--docker", code=Exit.FAILED)
    assert "Neither Docker (with buildx) nor Podman nor Buildah answers" in ran.err
    assert "leave --docker out" in " ".join(ran.err.split())


def test_a_failure_of_docker_is_reported(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.docker = fake_docker(
        tmp_path / "bin", build=1, says="#7 ERROR: No matching distribution found for nosuch"
    )
    monkeypatch.setenv("PATH", str(register_world.docker))
    ran = register("--docker", code=Exit.FAILED)
    assert "requirements.txt asks for nosuch" in ran.err
    assert register_world.project() is None


@pytest.mark.parametrize("there", [{"engine": False}, {"buildx": False}])
def test_docker_without_an_engine_or_buildx_is_not_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: dict[str, bool]
) -> None:
    monkeypatch.setenv("PATH", str(fake_docker(tmp_path / "bin", **there)))
    assert not BUILDERS[0].answers()


def test_another_mirror_of_the_base_makes_another_image(tmp_path: Path) -> None:
    usual, mirrored = make_bundle(tmp_path), make_bundle(tmp_path, "mirror.example/python:3.13-slim")
    assert usual.hash != mirrored.hash
    assert b"\nARG BASE=mirror.example/python:3.13-slim\n" in mirrored.entries["Dockerfile"]
    with pytest.raises(Problem, match="no name of an image"):
        make_bundle(tmp_path, "x\nRUN evil")
