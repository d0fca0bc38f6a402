"""The ECR repository of the projects' images.

If the repository has an image's tag, it has the whole image: a push uploads the layers first and the manifest, which
carries the tag, last (ECR API Reference, PutImage). A push that was interrupted leaves no tag.

A tag tells an image's content: `{project}-{content}`. The repository is immutable, so a tag never moves to another
image. A second image with the same content gets the tag `{project}-{content}.2`, and so on; the newest one is used.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account


class Tagged(NamedTuple):
    """An image in the repository with one of its tags. Sorting them gives the order in which they were pushed."""

    pushed: datetime
    number: int  # 1 for the first image with this content, 2 for the second, and so on
    content: str  # the tag without the number
    tag: str
    digest: str


@dataclass(frozen=True)
class ImageRepository:
    """A repository by its URI, such as 123456789012.dkr.ecr.ca-central-1.amazonaws.com/hippodrome."""

    account: Account
    uri: str

    @property
    def registry(self) -> str:
        """The repository's host, for `docker login`."""
        return self.uri.partition("/")[0]

    @property
    def address(self) -> str:
        """The address of the registry's API."""
        return f"https://{self.registry}"

    @property
    def name(self) -> str:
        return self.uri.partition("/")[2]

    def images(self) -> Images:
        """List the images that have a tag, 1,000 with each request. Raises `Problem` if the repository is gone."""
        tagged_images: list[Tagged] = []
        pages = self._client.get_paginator("describe_images").paginate(
            repositoryName=self.name, filter={"tagStatus": "TAGGED"}, PaginationConfig={"PageSize": 1000}
        )
        try:
            for image in (image for page in pages for image in page["imageDetails"]):
                for tag in image.get("imageTags", []):
                    content, _, number = tag.partition(".")
                    nth = int(number) if number.isdecimal() else 1
                    tagged_images.append(Tagged(image["imagePushedAt"], nth, content, tag, image["imageDigest"]))
        except ClientError as error:
            if errors.code(error) != "RepositoryNotFoundException":
                raise
            raise Problem(
                f"The repository {self.name} is not there any more.", "Run `hippodrome deploy` to make it again."
            ) from None
        return Images(self.uri, sorted(tagged_images))

    def password(self) -> str:
        """Ask for the password for `docker login` as the user `AWS`. It is valid for twelve hours."""
        token = self._client.get_authorization_token()["authorizationData"][0]["authorizationToken"]
        return base64.b64decode(token).decode().partition(":")[2]

    @cached_property
    def _client(self) -> Any:
        return self.account.client("ecr")


@dataclass(frozen=True)
class Images:
    """The images of a repository, oldest first."""

    uri: str
    found: list[Tagged]

    def of(self, content: str) -> str | None:
        """Return the newest image with this content, as uri@digest; None if there is none."""
        same = [image for image in self.found if image.content == content]
        return f"{self.uri}@{same[-1].digest}" if same else None

    def tagged(self, tag: str) -> str | None:
        """Return the image with this tag, as uri@digest; None if there is none."""
        return next((f"{self.uri}@{image.digest}" for image in self.found if image.tag == tag), None)

    def next_tag(self, content: str) -> str:
        """Return the tag for the next image with this content."""
        most = max((image.number for image in self.found if image.content == content), default=0)
        return f"{content}.{most + 1}" if most else content


def content_tag(project_id: str, content: str) -> str:
    """Return the tag of a project's image with this content.

    A project's id may begin with a dash, but a tag must not.
    """
    return f"{'x' if project_id.startswith('-') else ''}{project_id}-{content}"
