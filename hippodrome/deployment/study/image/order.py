"""The input of a builder."""

from __future__ import annotations

from dataclasses import dataclass

from hippodrome.deployment.study.image.bundle import Bundle
from hippodrome.deployment.study.image.ecr import ImageRepository


@dataclass(frozen=True)
class Order:
    """Build this bundle and push it to the repository under this tag."""

    repository: ImageRepository
    content: str  # the tag without a number: the project's id and the hash of the bundle
    tag: str
    bundle: Bundle
    fresh: bool = False  # use no layers of earlier images, so that the newest base is pulled
    cache_from: str = ""  # an earlier image (uri:tag) whose layers may be used

    @property
    def image(self) -> str:
        """The image's address: uri:tag."""
        return f"{self.repository.uri}:{self.tag}"

    def arrived(self) -> str | None:
        """Look whether the repository has the image. Return it as uri@digest, or None."""
        return self.repository.images().tagged(self.tag)
