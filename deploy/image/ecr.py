"""The repository of images, in ECR.

An image is there when its tag is: a push uploads the layers first and the manifest, which carries the tag, last (ECR
API Reference, PutImage). So a push that was cut off leaves nothing that `find` could take for an image.
"""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from botocore.exceptions import ClientError

from deploy.account import Account
from deploy.problem import Problem


@dataclass(frozen=True)
class Repository:
    """A repository by its URI, such as 123456789012.dkr.ecr.ca-central-1.amazonaws.com/hippodrome."""

    account: Account
    uri: str

    @property
    def registry(self) -> str:
        """The host, which `docker login` wants."""
        return self.uri.partition("/")[0]

    @property
    def name(self) -> str:
        return self.uri.partition("/")[2]

    def find(self, tag: str) -> str | None:
        """The image of that tag as uri@digest; None if it is not there, or not in full. Raises `Problem`."""
        try:
            images = self._client.describe_images(repositoryName=self.name, imageIds=[{"imageTag": tag}])
        except ClientError as error:
            if error.response["Error"]["Code"] == "ImageNotFoundException":
                return None
            if error.response["Error"]["Code"] == "RepositoryNotFoundException":
                raise Problem(
                    f"The repository {self.name} is not there any more.",
                    "Run `python -m deploy apply` to make it again.",
                ) from None
            raise
        details = images.get("imageDetails", [])
        return f"{self.uri}@{details[0]['imageDigest']}" if details else None

    def newest(self, project_id: str) -> str:
        """The image (uri:tag) whose layers a new one of this project is most likely to share; "" if there is none."""
        own = re.compile(re.escape(tag(project_id, "")) + r"[0-9a-f]{12}")
        found = [
            (bool(own.fullmatch(name)), image["imagePushedAt"], name)
            for image in self._images()
            for name in image.get("imageTags", [])
        ]
        return f"{self.uri}:{max(found)[2]}" if found else ""

    def password(self) -> str:
        """What `docker login` takes for the user AWS; good for twelve hours."""
        given = self._client.get_authorization_token()["authorizationData"][0]["authorizationToken"]
        return base64.b64decode(given).decode().partition(":")[2]

    def _images(self) -> Iterator[Mapping[str, Any]]:
        pages = self._client.get_paginator("describe_images")
        for page in pages.paginate(repositoryName=self.name, filter={"tagStatus": "TAGGED"}):
            yield from page["imageDetails"]

    @property
    def _client(self) -> Any:
        return self.account.client("ecr")


def tag(project_id: str, content: str) -> str:
    """The tag of a project's image with that content. A tag cannot begin with a dash, as a project's id may."""
    return f"{'x' if project_id.startswith('-') else ''}{project_id}-{content}"
