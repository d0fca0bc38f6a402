"""What `register` needs of AWS beyond `Installed`: images in ECR, and the function that registers.

moto has no registry behind its ECR, and its Lambda runs functions only with Docker. So images are not assembled here but
put into ECR (tests/deployment/study/test_image_runs.py assembles them), and Invoke runs the real handler over the same
account.
"""

from __future__ import annotations

import io
import json
import stat
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import botocore.handlers
import pytest
from botocore.awsrequest import AWSResponse
from botocore.exceptions import ClientError
from botocore.response import StreamingBody

from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json
from hippodrome.deployment.study.image import assembled
from hippodrome.deployment.study.image.order import Order
from hippodrome.functions import installed, update_project_master_list
from tests.deployment.installation import CommandResult, Installed

CONFIG = """\
project:
  id: maze
  name: A maze
  maxRuntime: 30
  steps: {1: consent, 2: game, 3: thanks}
  useAWS: true
  awsSetup: {cpu: 1, memory: 2}
trial:
  game: ALE/MsPacman-v5
"""


@dataclass
class RegisterWorld(Installed):
    """`Installed` with what `register` calls."""

    fails: Problem | None = None  # why an image cannot be assembled
    push: bool = True  # whether an image that is assembled arrives
    builds: list[Order] = field(default_factory=list)  # the images that were to be assembled
    function_error: bool = False
    interrupt: int | None = None  # the call of a command, counted from 0, at which Ctrl-C is pressed
    made: list[str] = field(default_factory=list)  # the calls of commands, not of functions
    asked: list[tuple[str, dict[str, Any]]] = field(default_factory=list)  # the same with their parameters
    docker: Path | None = None  # the folder of `fake_docker`

    def __post_init__(self) -> None:
        super().__init__()
        self._inside = threading.local()

    def __enter__(self) -> RegisterWorld:
        super().__enter__()
        ours: tuple[str, Any] = ("before-call", self._before_call)
        botocore.handlers.BUILTIN_HANDLERS.append(ours)
        self._stack.callback(botocore.handlers.BUILTIN_HANDLERS.remove, ours)
        installed.use(self.platform)
        self._stack.callback(installed.use, None)
        patch = self._stack.enter_context(pytest.MonkeyPatch.context())
        patch.setattr(assembled, "build", self._assemble)
        return self

    @property
    def outputs(self) -> dict[str, str]:
        """The outputs with `MotoWorld`'s role, because start_server may pass no other."""
        return {**super().outputs, "TaskExecutionRole": self.ids["task_execution_role"]}

    def template(self) -> dict[str, Any]:
        return {**super().template(), "Parameters": {"ServerNames": {"Type": "String", "Default": "hash"}}}

    # -- looking ------------------------------------------------------------------------------------------------------

    def project(self, project_id: str = "maze") -> Project | None:
        """Return the project as it is registered; None without a registration."""
        if MASTER_LIST not in self.keys():
            return None
        return from_json(self.get(MASTER_LIST), MasterList).find(project_id)

    def image_tags(self) -> list[str]:
        pages = self.client("ecr").get_paginator("describe_images").paginate(repositoryName="hippodrome")
        return sorted(tag for page in pages for image in page["imageDetails"] for tag in image.get("imageTags", []))

    def revisions(self, family: str = "hippodrome-maze") -> list[str]:
        return self.client("ecs").list_task_definitions(familyPrefix=family)["taskDefinitionArns"]

    # -- answering ----------------------------------------------------------------------------------------------------

    def _before_call(self, model: Any, params: Any, context: dict[str, Any], **_: Any) -> Any:
        action = f"{model.service_model.service_name}:{model.name}"
        if not getattr(self._inside, "function", False):
            with self._lock:
                self.made.append(action)
                self.asked.append((action, context.get("hippodrome_params", {})))
                if self.interrupt is not None and len(self.made) > self.interrupt:
                    raise KeyboardInterrupt
        if action == "ecr:DescribeImages":
            self._store_pushed()
        answer = {"lambda:Invoke": self._invoke}.get(action)
        if answer is None:
            return None
        with self._lock:
            parsed = answer(params["body"])
        return AWSResponse(params["url"], 200, {}, None), {**parsed, "ResponseMetadata": {"HTTPStatusCode": 200}}

    def _invoke(self, body: bytes) -> dict[str, Any]:
        self._inside.function = True
        try:
            reply = json.dumps(update_project_master_list.handler(json.loads(body), None)).encode()
        finally:
            self._inside.function = False
        if self.function_error:
            return {"StatusCode": 200, "FunctionError": "Unhandled", "Payload": _stream(b'{"errorType": "KeyError"}')}
        return {"StatusCode": 200, "Payload": _stream(reply)}

    def _assemble(self, order: Order) -> None:
        order.repository.password()
        with self._lock:
            self.builds.append(order)
        if self.fails:
            raise self.fails
        if self.push:
            try:
                self.put_image(order.tag)
            except ClientError as error:
                assert errors.code(error) == "ImageTagAlreadyExistsException"
                raise Problem("ECR refused a request for hippodrome (HTTP 400).") from None

    def put_image(self, tag: str) -> None:
        """Store an image, as a finished push does, which is no call of a command."""
        digest = f"sha256:{abs(hash((tag, time.time_ns()))):064x}"[:71]
        manifest = {
            "schemaVersion": 2,
            "mediaType": "application/vnd.oci.image.manifest.v1+json",
            "layers": [{"digest": digest}],
        }
        self._inside.function = True
        try:
            self.client("ecr").put_image(
                repositoryName="hippodrome",
                imageTag=tag,
                imageManifest=json.dumps(manifest | {"config": {"size": 1, "digest": digest}}),
            )
        finally:
            self._inside.function = False

    def _store_pushed(self) -> None:
        """Store the images that `fake_docker` has pushed since the last call."""
        pushed = self.docker / "pushed" if self.docker else None
        if pushed and pushed.exists():
            tags = pushed.read_text().split()
            pushed.unlink()
            for tag in tags:
                self.put_image(tag)


def _stream(body: bytes) -> StreamingBody:
    return StreamingBody(io.BytesIO(body), len(body))


def fake_docker(
    folder: Path,
    *,
    engine: bool = True,
    buildx: bool = True,
    build: int = 0,
    says: str = "#1 DONE",
    program: str = "docker",
) -> Path:
    """Return a folder for PATH with this program: it records its calls, with the files of the context, and its pushes."""
    folder.mkdir(parents=True, exist_ok=True)
    script = folder / program
    script.write_text(
        textwrap.dedent(f"""\
        #!{sys.executable}
        import json, pathlib, sys
        here, words = pathlib.Path({str(folder)!r}), sys.argv[1:]
        call = {{"words": words, "stdin": sys.stdin.read() if words[0] == "login" else ""}}
        if words[0] in ("version", "info"):
            sys.exit(0 if {engine} else 1)
        if words[:2] == ["buildx", "version"]:
            sys.exit(0 if {buildx} else 1)
        builds = "build" in words[:2]
        if builds:
            context = pathlib.Path(words[-1])
            call["files"] = sorted(p.relative_to(context).as_posix() for p in context.rglob("*") if p.is_file())
        with (here / "calls").open("a") as out:
            out.write(json.dumps(call) + "\\n")
        if {build} == 0 and ("--push" in words or words[0] == "push"):
            image = words[words.index("--tag") + 1] if builds else words[1]
            with (here / "pushed").open("a") as out:
                out.write(image.rpartition(":")[2] + "\\n")
        if builds:
            print({says!r})
            sys.exit({build})
        """)
    )
    script.chmod(script.stat().st_mode | stat.S_IXUSR)
    return folder


def docker_calls(folder: Path) -> list[dict[str, Any]]:
    calls = folder / "calls"
    return [json.loads(line) for line in calls.read_text().splitlines()] if calls.exists() else []


def write_study(folder: Path, config: str = CONFIG, **files: str) -> Path:
    """Write a small study for AWS. `files` are below the folder, `__` for a slash and `_DOT_` for a dot."""
    (folder / "steps").mkdir(parents=True, exist_ok=True)
    (folder / "config.yml").write_text(config)
    (folder / "steps/consent.html").write_text("<p>Do you agree?</p>")
    (folder / "steps/thanks.html").write_text("<p>Thank you!</p><img src='maze.png'>")
    (folder / "steps/maze.png").write_bytes(b"\x89PNG not really")
    (folder / "agent.py").write_text("class Agent:\n    pass\n")
    for name, text in files.items():
        path = folder / name.replace("__", "/").replace("_DOT_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """A machine without Docker."""
    monkeypatch.setenv("PATH", str(tmp_path_factory.mktemp("bin")))


@pytest.fixture
def register_world(machine: None) -> Iterator[RegisterWorld]:
    """An installation, and a machine without Docker."""
    with RegisterWorld() as world:
        yield world


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a study's folder."""
    return write_study(tmp_path / "study")


class Register(Protocol):
    """`register` of the folder with more arguments; with `code`, it has to end so."""

    def __call__(self, *arguments: str, code: Exit | None = None) -> CommandResult: ...


@pytest.fixture
def register(register_world: RegisterWorld, capsys: pytest.CaptureFixture[str], folder: Path) -> Register:
    """Return what registers the folder."""

    def call(*arguments: str, code: Exit | None = None) -> CommandResult:
        ran = register_world.run(capsys, "register", str(folder), *arguments)
        assert code is None or ran.code == code, ran.err
        return ran

    return call


def configure(folder: Path, *changes: tuple[str, str]) -> None:
    """Replace texts of the study's config.yml: pairs of (old, new)."""
    text = CONFIG
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "config.yml").write_text(text)


def bodies(register_world: RegisterWorld) -> dict[str, bytes]:
    """Return the contents of the study `maze` in the bucket, by key."""
    return {key: register_world.get(key) for key in register_world.keys("maze/")}
