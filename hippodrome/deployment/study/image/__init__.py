"""A project's image, which its servers run. It is built only if the repository has none with the same content."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.study.image import builders
from hippodrome.deployment.study.image.bundle import make_bundle
from hippodrome.deployment.study.image.ecr import ImageRepository, content_tag
from hippodrome.deployment.study.image.order import Order

__all__ = ["Image", "ImagePlan", "build", "plan"]


@dataclass(frozen=True)
class ImagePlan:
    """A comparison of a project's files with the repository. `uri` (with digest) is the image with the same content."""

    uri: str | None  # None: the image has to be built
    order: Order  # how to build it


@dataclass(frozen=True)
class Image:
    """An image in the repository. `uri` has its digest. `built`: whether it was built just now."""

    uri: str
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
    """Compare the project's files with the images in the repository. Changes nothing.

    `again`: make an image in any case, with the newest base and packages. `base` and `trial` are as in `make_bundle`.
    Raises `Problem` as `make_bundle` does, or if the repository is gone.
    """
    bundle = make_bundle(folder, base, trial)
    repository = ImageRepository(account, installation["Repository"])
    content = content_tag(project_id, bundle.hash)
    images = repository.images()
    order = Order(repository, content, images.next_tag(content), bundle, fresh=again)
    return ImagePlan(None if again else images.of(content), order)


def build(image_plan: ImagePlan, *, by_dockerfile: bool = False) -> Image:
    """Make the image of the plan unless the repository has it, and return it. Raises `Problem` if that fails.

    It is assembled here, or built by the Dockerfile, with the Docker, Podman or Buildah of this machine.
    """
    if image_plan.uri:
        return Image(image_plan.uri, built=False)
    order = image_plan.order
    try:
        if by_dockerfile:
            builders.build(order)
        else:
            from hippodrome.deployment.study.image import assembled  # noqa: PLC0415 - only a new image needs it

            screen.info("Assembling the image …")
            assembled.build(order)
    except Problem:
        if order.arrived() is None:
            raise
        screen.warning("Another command has made the same image meanwhile.")  # so the repository refused the tag
    uri = order.arrived()
    if uri is None:
        raise Problem("The image was made, but it is not in the repository.", "Run the same command again.")
    return Image(uri, built=True)
