"""Builds an image by its Dockerfile, with the Docker, Podman or Buildah of this machine.

For what assembling cannot do: packages that have to be compiled, and bases that need a login.
"""

# ruff: noqa: S603 - the programs are found on PATH on purpose, and their arguments are lists that no shell reads

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.deployment.study.image.ecr import ImageRepository
from hippodrome.deployment.study.image.follow import BuildLog
from hippodrome.deployment.study.image.order import Order

PATIENCE = 15  # seconds to wait for an answer of an engine


@dataclass(frozen=True)
class Builder:
    """How a program builds images: what it is asked to see whether it can, and its words for a build and a push."""

    program: str
    questions: Sequence[Sequence[str]]
    build: Sequence[str]
    fresh: Sequence[str]
    push: Sequence[str] = ()  # with the image's address after it; empty if `build` pushes

    def answers(self) -> bool:
        """Whether the program is here and works. The command `docker` alone needs an engine, and buildx."""
        for words in self.questions:
            try:
                answer = subprocess.run(
                    [self.program, *words], capture_output=True, timeout=PATIENCE, check=False, stdin=subprocess.DEVNULL
                )
            except (OSError, subprocess.TimeoutExpired):
                return False
            if answer.returncode:
                return False
        return True


# Without --layers, Buildah puts everything into one layer, which would be sent whole after each change of agent.py.
_LAYERS = ("build", "--platform", "linux/amd64", "--layers", "--format", "oci")
_FRESH = ("--no-cache", "--pull")
BUILDERS = (
    Builder(
        "docker",
        (("version", "--format", "{{.Server.Version}}"), ("buildx", "version")),
        ("buildx", "build", "--platform", "linux/amd64", "--provenance=false", "--progress", "plain", "--push"),
        _FRESH,
    ),
    Builder("podman", (("info",),), _LAYERS, _FRESH, ("push",)),
    Builder("buildah", (("info",),), _LAYERS, ("--no-cache", "--pull-always"), ("push",)),
)


def build(order: Order) -> None:
    """Build the image and push it. Raises `Problem` with the log's last lines. Finished layers are kept."""
    builder = next((builder for builder in BUILDERS if builder.answers()), None)
    if builder is None:
        raise Problem(
            "Neither Docker (with buildx) nor Podman nor Buildah answers on this machine.",
            "Start or install one of them; or leave --docker out, which needs none.",
        )
    screen.info(f"Building the image with {builder.program.capitalize()} …")
    _login(builder.program, order.repository)
    with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
        order.bundle.write_folder(Path(folder))
        fresh = builder.fresh if order.fresh else ()
        _follow([builder.program, *builder.build, *fresh, "--tag", order.image, folder])
        if builder.push:
            _follow([builder.program, *builder.push, order.image])


def _follow(command: Sequence[str]) -> None:
    log = BuildLog()
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
    ) as process:
        try:
            assert process.stdout is not None
            for line in process.stdout:
                log.add(line)
        except KeyboardInterrupt:
            process.terminate()
            screen.warning("The build was ended; the layers that were finished are kept.")
            raise
    if process.returncode:
        raise log.failure("The image could not be built.")


def _login(program: str, repository: ImageRepository) -> None:
    command = [program, "login", "--username", "AWS", "--password-stdin", repository.registry]
    done = subprocess.run(command, input=repository.password(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise Problem(
            f"{program.capitalize()} could not log in to the repository of images.",
            f"Look at what {program} says, or leave --docker out.",
            done.stderr.strip().splitlines()[-3:],
        )
