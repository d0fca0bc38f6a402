"""What is to be made: an image of a project."""

from __future__ import annotations

from dataclasses import dataclass

from hippodrome.deployment.study.image.bundle import Bundle
from hippodrome.deployment.study.image.ecr import ImageRepository


@dataclass(frozen=True)
class Order:
    """Make an image of this bundle and push it to the repository under this tag."""

    repository: ImageRepository
    content: str  # the tag without a number: the project's id and the hash of the bundle
    tag: str
    bundle: Bundle
    fresh: bool = False  # take the newest base and packages, and nothing of earlier images

    @property
    def image(self) -> str:
        """The image's address: uri:tag."""
        return f"{self.repository.uri}:{self.tag}"

    def arrived(self) -> str | None:
        """Look whether the repository has the image. Return it as uri@digest, or None."""
        return self.repository.images().tagged(self.tag)
