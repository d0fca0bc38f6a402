"""Images that Docker builds on this machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from console.problem import Exit, Problem
from deploy.study.image import docker
from deploy.study.image.bundle import make_bundle
from tests.deploy.registering import Town, docker_calls, fake_docker, folder, machine, town

__all__ = ["folder", "machine", "town"]


def test_where_docker_runs_it_builds(
    town: Town, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.docker = fake_docker(tmp_path / "bin")
    monkeypatch.setenv("PATH", str(town.docker))
    town.put_image("maze-aaaaaaaaaaaa")
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert town.builds == []
    calls = docker_calls(town.docker)
    login = next(call for call in calls if call["words"][0] == "login")
    assert login["words"][-1] == town.repository.partition("/")[0]
    assert login["stdin"]
    assert not any(login["stdin"] in word for call in calls for word in call["words"])
    build = calls[-1]["words"]
    assert build[build.index("--platform") + 1] == "linux/amd64"
    assert build[build.index("--cache-from") + 1] == f"type=registry,ref={town.repository}:maze-aaaaaaaaaaaa"
    assert "--push" in build
    assert {"Dockerfile", "trial/__main__.py", "project/agent.py", "requirements/project.txt"} <= set(
        calls[-1]["files"]
    )
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    assert docker_calls(town.docker) == calls  # nothing is built twice


def test_docker_may_be_left_alone(
    town: Town, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.docker = fake_docker(tmp_path / "bin")
    monkeypatch.setenv("PATH", str(town.docker))
    assert town.run(capsys, "register", str(folder), "--build-on-aws").code == Exit.DONE
    assert len(town.builds) == 1
    assert docker_calls(town.docker) == []


def test_a_failing_docker_says_why(
    town: Town, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.docker = fake_docker(tmp_path / "bin", build=1, says="#7 ERROR: No matching distribution found for nosuch")
    monkeypatch.setenv("PATH", str(town.docker))
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "requirements.txt asks for nosuch" in ran.err
    assert town.project() is None


@pytest.mark.parametrize("there", [{"engine": False}, {"buildx": False}])
def test_docker_without_an_engine_or_buildx_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: dict[str, bool]
) -> None:
    monkeypatch.setenv("PATH", str(fake_docker(tmp_path / "bin", **there)))
    assert not docker.available()


def test_no_docker_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert not docker.available()


def test_a_mirror_of_the_base_makes_another_image(tmp_path: Path) -> None:
    usual, mirrored = make_bundle(tmp_path), make_bundle(tmp_path, "mirror.example/python:3.13-slim")
    assert usual.hash != mirrored.hash
    assert b"\nARG BASE=mirror.example/python:3.13-slim\n" in mirrored.entries["Dockerfile"]
    with pytest.raises(Problem, match="no name of an image"):
        make_bundle(tmp_path, "x\nRUN evil")
