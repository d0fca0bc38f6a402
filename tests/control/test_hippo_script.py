"""HIPPO's `updateProject.py` on AWS, call by call; the role of each function must allow the function's calls."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.functions import installed, next_step, update_project_master_list
from testing.aws_events import JSON, http_event
from testing.moto_world import MotoWorld

CONFIG: dict[str, Any] = {
    "useAWS": True,
    "awsSetup": {"region": "us-east-1", "rootDomain": "example.org", "cpu": None, "memory": None},
    "events": {"startServerStep": 2, "stopServerStep": 4},
    "id": "flight", "live": True, "maxRuntime": 60, "name": "Flight", "researcher": "R",
    "ssl": {"fullchain": "SSL/fullchain.pem", "privkey": "SSL/privkey.pem", "sslBucket": None},
    "steps": {1: "consent.html", 2: "survey.html", 3: "game", 4: "quiz.html", 5: None, "finalStep": "thank.html"},
    "teamMembers": None,
}  # fmt: skip


@pytest.fixture
def world() -> Iterator[MotoWorld]:
    with MotoWorld() as made:
        installed.use(made.platform)
        yield made


def ask(body: dict[str, str] | None = None) -> dict[str, Any]:
    """Return the answer to a request of HIPPO's front end."""
    headers = {
        "accept": "application/json, text/plain, */*",
        "content-type": JSON,
        "origin": "https://play.example.org",
    }
    sent = None if body is None else json.dumps(body)
    event = http_event("POST" if body else "GET", "projectId=flight&userId=0a1b-2c3d", sent, headers=headers)
    answer = next_step.handler(event, None)
    assert answer["statusCode"] == 200, answer
    found: dict[str, Any] = json.loads(answer["body"])
    return found


def test_the_script_registers_a_study_whose_pages_open(world: MotoWorld) -> None:
    assert world.iam
    bucket = world.env["BUCKET"]
    project = {**CONFIG, "awsSetup": {**CONFIG["awsSetup"], "bucket": bucket, "containerName": "flight"}}
    for page in ("consent.html", "survey.html", "quiz.html", "thank.html"):
        body = f"<p>This is {page}</p><input name='a'>".encode()
        world.client("s3").put_object(
            Bucket=bucket, Key=f"flight/{page}", Body=body, ContentEncoding="utf-8", StorageClass="STANDARD"
        )
    payload = json.loads(json.dumps({**project, "ecsTask": "flight", "bucket": bucket}))
    answer = update_project_master_list.handler(payload, None)
    assert answer["statusCode"] == 200, answer["body"]

    seen = ask()
    assert "This is consent.html" in seen["page"]
    seen = ask({"hippodrome-step": seen["step"], "hippodrome-ticket": seen["ticket"], "a": "1"})
    assert "This is survey.html" in seen["page"]
    assert ask({"hippodrome-step": seen["step"], "hippodrome-ticket": seen["ticket"], "a": "2"})["page"] == "wait"
