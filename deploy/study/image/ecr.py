"""The repository of images, in ECR.

An image is there when its tag is: a push uploads the layers first and the manifest, which carries the tag, last (ECR
API Reference, PutImage). So a push that was cut off leaves nothing that could be taken for an image.

Tags say what is in an image: `{project}-{content}`. They are never moved to another image (the repository is
immutable), so one that was built anew from the same content gets `{project}-{content}.2` and so on, and the newest
counts.
"""

from __future__ import annotations

import base64
import re
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from console.problem import Problem
from deploy.aws.account import Account
from hippodrome.aws import errors


class Tagged(NamedTuple):
    """An image in the repository. The order of these is that in which they were pushed."""

    pushed: datetime
    number: int  # of images with this content, this was the n-th
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
    def name(self) -> str:
        return self.uri.partition("/")[2]

    def images(self) -> Images:
        """The present images: a DescribeImages for each 1,000. Raises `Problem` if the repository is gone."""
        found: list[Tagged] = []
        pages = self._client.get_paginator("describe_images").paginate(
            repositoryName=self.name, filter={"tagStatus": "TAGGED"}, PaginationConfig={"PageSize": 1000}
        )
        try:
            for image in (image for page in pages for image in page["imageDetails"]):
                for tag in image.get("imageTags", []):
                    content, _, number = tag.partition(".")
                    times = int(number) if number.isdecimal() else 1
                    found.append(Tagged(image["imagePushedAt"], times, content, tag, image["imageDigest"]))
        except ClientError as error:
            if errors.code(error) != "RepositoryNotFoundException":
                raise
            raise Problem(
                f"The repository {self.name} is not there any more.", "Run `python -m deploy apply` to make it again."
            ) from None
        return Images(self.uri, sorted(found))

    def password(self) -> str:
        """The password of the user AWS for `docker login`; valid for twelve hours."""
        given = self._client.get_authorization_token()["authorizationData"][0]["authorizationToken"]
        return base64.b64decode(given).decode().partition(":")[2]

    @cached_property
    def _client(self) -> Any:
        return self.account.client("ecr")


@dataclass(frozen=True)
class Images:
    """The images of a repository, oldest first."""

    uri: str
    found: list[Tagged]

    def of(self, content: str) -> str | None:
        """The newest image with this content, as uri@digest; None if there is none."""
        same = [image for image in self.found if image.content == content]
        return f"{self.uri}@{same[-1].digest}" if same else None

    def tagged(self, tag: str) -> str | None:
        """The image with this tag, as uri@digest; None if there is none."""
        return next((f"{self.uri}@{image.digest}" for image in self.found if image.tag == tag), None)

    def next_tag(self, content: str) -> str:
        """The tag for the next image with this content."""
        most = max((image.number for image in self.found if image.content == content), default=0)
        return f"{content}.{most + 1}" if most else content

    def alike(self, project_id: str) -> str:
        """The image (uri:tag) with which a new one of this project probably shares most layers; "" if there is none."""
        own = re.compile(re.escape(content_tag(project_id, "")) + r"[0-9a-f]{12}")
        best = max(self.found, key=lambda image: (own.fullmatch(image.content) is not None, image), default=None)
        return f"{self.uri}:{best.tag}" if best else ""


def content_tag(project_id: str, content: str) -> str:
    """The tag of a project's image with this content. A tag cannot begin with a dash, as a project's id may."""
    return f"{'x' if project_id.startswith('-') else ''}{project_id}-{content}"
