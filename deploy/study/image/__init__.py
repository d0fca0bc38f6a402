"""A project's image: what its servers run. It is built only if no image with the very same content is there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from console import screen
from console.problem import Problem
from deploy.aws.account import Account, Installation
from deploy.study.image import docker
from deploy.study.image.bundle import Bundle, make_bundle
from deploy.study.image.codebuild import Builder
from deploy.study.image.ecr import ImageRepository, content_tag
from deploy.study.image.order import Order

__all__ = ["Image", "Plan", "build", "plan"]


@dataclass(frozen=True)
class ImagePlan:
    """What a project's image must hold, and the image's `uri` (by its digest) if there is one already."""

    content: str  # the tag that says what is in it
    bundle: Bundle
    uri: str | None
    order: Order


@dataclass(frozen=True)
class Image:
    """An image in the repository, by its digest. `built`: it was built just now."""

    uri: str
    content: str
    built: bool


def plan(
    account: Account,
    installation: Installation,
    project_id: str,
    folder: Path,
    *,
    again: bool = False,
    base: str = "",
    trial: Mapping[str, Any] | None = None,
) -> ImagePlan:
    """Look at the project's files and at the repository; nothing is changed. `again`: build in any case. `trial`: the
    section of config.yml, with which the agent is tried.

    Raises `Problem`.
    """
    bundle = make_bundle(folder, base, trial)
    repository = ImageRepository(account, installation["Repository"])
    content = content_tag(project_id, bundle.hash)
    images = repository.images()
    cache = "" if again else images.alike(project_id)
    order = Order(repository, content, images.next_tag(content), bundle, fresh=again, cache_from=cache)
    return ImagePlan(content, bundle, None if again else images.of(content), order)


def build(installation: Installation, wanted: ImagePlan, *, on_aws: bool = False) -> Image:
    """Return the image of the plan, and build it if there is none. Raises `Problem`.

    Built by the Docker of this machine, or by CodeBuild where there is none or `on_aws`.
    """
    if wanted.uri:
        return Image(wanted.uri, wanted.content, built=False)
    order = wanted.order
    try:
        if not on_aws and docker.available():
            screen.info("Building the image with the Docker of this machine …")
            docker.build(order)
        else:
            screen.info("Building the image at AWS (CodeBuild); the first time takes some minutes …")
            Builder(order.repository.account, installation["ImageBuilder"], installation["Bucket"]).build(order)
    except Problem:
        if order.arrived() is None:
            raise
        screen.warning("Another build has made the same image meanwhile.")  # a tag is given only once
    uri = order.arrived()
    if uri is None:
        raise Problem("The image was built, but it is not in the repository.", "Run the same command again.")
    return Image(uri, wanted.content, built=True)
