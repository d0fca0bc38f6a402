"""A project's image: what its servers run. It is built only if no image with the very same content is there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from deploy import screen
from deploy.account import Account, Installation
from deploy.image import docker
from deploy.image.bundle import Bundle, make_bundle
from deploy.image.codebuild import Builder
from deploy.image.ecr import Repository, tag
from deploy.image.order import Order
from deploy.problem import Problem

__all__ = ["Image", "Plan", "build", "plan"]


@dataclass(frozen=True)
class Plan:
    """What a project's image must hold, and whether there is one already (`uri`)."""

    repository: Repository
    project_id: str
    tag: str
    bundle: Bundle
    uri: str | None


@dataclass(frozen=True)
class Image:
    """An image in the repository: `uri` names it by its digest. `built`: it was made just now."""

    uri: str
    tag: str
    built: bool


def plan(account: Account, installation: Installation, project_id: str, folder: Path) -> Plan:
    """Look at the project's files and at the repository; nothing is changed. Raises `Problem`."""
    bundle = make_bundle(folder)
    repository = Repository(account, installation["Repository"])
    name = tag(project_id, bundle.hash)
    return Plan(repository, project_id, name, bundle, repository.find(name))


def build(installation: Installation, wanted: Plan, *, again: bool = False, on_aws: bool = False) -> Image:
    """The image of the plan: that which is there, or a new one. `again`: a new one all the same.

    Built by the Docker of this machine, or by CodeBuild where there is none or `on_aws`. Raises `Problem`.
    """
    repository = wanted.repository
    if wanted.uri and not again:
        return Image(wanted.uri, wanted.tag, built=False)
    cache = "" if again else repository.newest(wanted.project_id)
    order = Order(repository, wanted.tag, wanted.bundle, fresh=again, cache_from=cache)
    if not on_aws and docker.available():
        screen.say("Building the image with the Docker of this machine …")
        docker.build(order)
    else:
        screen.say("Building the image at AWS (CodeBuild) …")
        Builder(repository.account, installation["ImageBuilder"], installation["Bucket"]).build(order)
    uri = repository.find(wanted.tag)
    if uri is None:
        raise Problem("The image was built, but it is not in the repository.", "Run the same command again.")
    return Image(uri, wanted.tag, built=True)
