"""Builds images with AWS CodeBuild, from a source bundle in the data bucket, and shows the log while it builds.

The build goes on at AWS if the command ends; a second run with the same content follows it.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from botocore.exceptions import ClientError

from hippodrome import places
from hippodrome.console import formatting, screen
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.study.image.follow import BuildLog
from hippodrome.deployment.study.image.order import Order

POLL = 3.0  # seconds between two looks at a build
_PHASES = {
    "QUEUED": "waiting for a builder",
    "PROVISIONING": "preparing the builder",
    "DOWNLOAD_SOURCE": "fetching the bundle",
    "PRE_BUILD": "logging in to the repository",
    "BUILD": "building and pushing",
    "POST_BUILD": "looking at the result",
}


def source_key(content: str) -> str:
    """Return the key of the source bundle in the data bucket."""
    return f"_builds/{content}.zip"


@dataclass(frozen=True)
class Builder:
    """Builds by a CodeBuild project, which fetches source bundles from `bucket`."""

    account: Account
    project: str
    bucket: str

    def build(self, order: Order) -> None:
        """Build and push the image, or follow a running build of it. Raises `Problem` if the build fails."""
        running = self._running(order)
        if running:
            screen.info("A build of the same content is running already; joining it.")
        elif order.arrived():  # the build ended a moment ago
            return
        else:
            self._upload(order)
            running = self._start(order)
        try:
            _follow(self.account, running)
        except KeyboardInterrupt:
            screen.warning("The build goes on at AWS without us; the same command joins it again.")
            raise

    def _running(self, order: Order) -> str | None:
        """Find a running build of this image. Return its id, or None."""
        client = self.account.client("codebuild")
        found = client.list_builds_for_project(projectName=self.project, sortOrder="DESCENDING")
        newest = found.get("ids", [])[:100]
        builds = client.batch_get_builds(ids=newest)["builds"] if newest else []
        for build in builds:
            listed = build.get("environment", {}).get("environmentVariables", [])
            variables = {one["name"]: one["value"] for one in listed}
            if build["buildStatus"] == "IN_PROGRESS" and variables.get("IMAGE") == order.image:
                return str(build["id"])
        return None

    def _upload(self, order: Order) -> None:
        """Upload the bundle, unless the bucket has one of this key, and so of this content."""
        s3, key = self.account.client("s3"), source_key(order.content)
        try:
            s3.head_object(Bucket=self.bucket, Key=key)
            return
        except ClientError as error:
            if errors.code(error) not in {"404", "NoSuchKey", "NotFound", "403"}:
                raise
        with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
            file = Path(folder, "bundle.zip")
            order.bundle.write_zip(file)
            screen.info(f"Uploading the files for the image ({formatting.size(file.stat().st_size)}) …")
            with file.open("rb") as body:  # not upload_file, which raises errors of its own
                s3.upload_fileobj(body, self.bucket, key, ExtraArgs={"ContentType": "application/zip"})

    def _start(self, order: Order) -> str:
        variables = {"IMAGE": order.image, "REGISTRY": order.repository.registry}
        if order.cache_from:  # a variable without a value may be refused
            variables["CACHE_FROM"] = order.cache_from
        try:
            started = self.account.client("codebuild").start_build(
                projectName=self.project,
                sourceTypeOverride="S3",
                sourceLocationOverride=f"{self.bucket}/{source_key(order.content)}",
                buildspecOverride=(places.ROOT / "infra/buildspec.yml").read_text(encoding="utf-8"),
                environmentVariablesOverride=[
                    {"name": name, "value": value, "type": "PLAINTEXT"} for name, value in variables.items()
                ],
            )
        except ClientError as error:
            if errors.code(error) == "AccountLimitExceededException":
                raise Problem(
                    "This AWS account may not run another build now.",
                    "Wait for the others, or have CodeBuild's quota 'Concurrently running builds' raised; new accounts "
                    "may have none. On a machine with Docker no build at AWS is needed.",
                ) from None
            raise
        return str(started["build"]["id"])


def _follow(account: Account, build_id: str) -> None:
    client, log = account.client("codebuild"), BuildLog()
    token: str | None = None
    shown = ""
    while True:
        found = client.batch_get_builds(ids=[build_id])["builds"]
        if not found:
            raise Problem("The build is gone.", "Run the same command again.")
        build = found[0]
        phase = build.get("currentPhase", "")
        if phase != shown and phase in _PHASES:
            screen.info(f"Build at AWS: {_PHASES[phase]} …")
        shown = phase
        token = _read_log(account, build, token, log)
        if build["buildStatus"] != "IN_PROGRESS":
            break
        time.sleep(POLL)
    if build["buildStatus"] != "SUCCEEDED":
        raise _failure(build, log)


def _read_log(account: Account, build: Mapping[str, Any], token: str | None, log: BuildLog) -> str | None:
    """Show the new lines of the build's log. Return the token at which the next call goes on."""
    logs = build.get("logs", {})
    if not logs.get("groupName") or not logs.get("streamName"):
        return token
    while True:
        more = {"nextToken": token} if token else {"startFromHead": True}
        try:
            page = account.client("logs").get_log_events(
                logGroupName=logs["groupName"], logStreamName=logs["streamName"], **more
            )
        except ClientError as error:
            if errors.code(error) == "ResourceNotFoundException":  # nothing has been written yet
                return token
            raise
        for event in page["events"]:
            log.add(event["message"])
        if page["nextForwardToken"] == token or not page["events"]:
            return str(page["nextForwardToken"])
        token = page["nextForwardToken"]


def _failure(build: Mapping[str, Any], log: BuildLog) -> Problem:
    status = build["buildStatus"]
    messages = [
        f"{phase['phaseType']}: {context['message']}"
        for phase in build.get("phases", [])
        for context in phase.get("contexts", [])
        if context.get("message")
    ]
    if status == "STOPPED":
        return Problem("The build was stopped.", "Run the same command to build again.")
    if status == "TIMED_OUT":
        return log.failure("The build took too long and was ended.", messages)
    return log.failure("The image could not be built.", messages)
