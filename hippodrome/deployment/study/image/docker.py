"""Builds images with the Docker engine of this machine, by buildx."""

# ruff: noqa: S603 - docker is found on PATH on purpose, and its arguments are a list that no shell reads

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.deployment.study.image.ecr import ImageRepository
from hippodrome.deployment.study.image.follow import BuildLog
from hippodrome.deployment.study.image.order import Order

PATIENCE = 15  # seconds to wait for an answer of the engine


def available() -> bool:
    """Whether a Docker engine answers and buildx is installed. The command `docker` alone is not enough."""
    if shutil.which("docker") is None:
        return False
    for command in (["docker", "version", "--format", "{{.Server.Version}}"], ["docker", "buildx", "version"]):
        try:
            answer = subprocess.run(command, capture_output=True, timeout=PATIENCE, check=False)
        except (OSError, subprocess.TimeoutExpired):
            return False
        if answer.returncode:
            return False
    return True


def build(order: Order) -> None:
    """Build the image and push it. Raises `Problem` with the log's last lines. Docker keeps finished layers."""
    _login(order.repository)
    command = ["docker", "buildx", "build", "--platform", "linux/amd64", "--provenance=false", "--progress", "plain"]
    command += ["--build-arg", "BUILDKIT_INLINE_CACHE=1"]
    command += ["--no-cache", "--pull"] if order.fresh else []
    command += ["--cache-from", f"type=registry,ref={order.cache_from}"] if order.cache_from else []
    with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
        order.bundle.write_folder(Path(folder))
        log = BuildLog()
        with subprocess.Popen(
            [*command, "--tag", order.image, "--push", folder],
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
                screen.warning("The build was ended; docker keeps the layers that were finished.")
                raise
        if process.returncode:
            raise log.failure("The image could not be built.")


def _login(repository: ImageRepository) -> None:
    command = ["docker", "login", "--username", "AWS", "--password-stdin", repository.registry]
    done = subprocess.run(command, input=repository.password(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise Problem(
            "Docker could not log in to the repository of images.",
            "Look at what docker says, or add --build-on-aws to build there.",
            done.stderr.strip().splitlines()[-3:],
        )
