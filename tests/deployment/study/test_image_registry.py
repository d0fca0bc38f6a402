"""The client of a registry, against a registry with the habits and the faults of others."""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Problem
from hippodrome.deployment.study.image import registry
from hippodrome.deployment.study.image.layers import Blob
from hippodrome.deployment.study.image.registry import Place, Repository, digest_of, place_of

BODY = b"a layer" * 1000
BLOB = Blob(digest_of(BODY), len(BODY))

Answer = tuple[int, dict[str, str], bytes]


class Registry:
    """Answers requests by `answers`, the newest first; notes what it was asked."""

    def __init__(self) -> None:
        self.answers: list[Callable[[str, str, dict[str, str], bytes], Answer | None]] = [self._usual]
        self.asked: list[tuple[str, str, str]] = []  # method, path, the header Authorization
        self.uploads: dict[str, bytes] = {}
        self.blobs: dict[str, bytes] = {}
        self.manifests: dict[str, bytes] = {}
        outer = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def _answer(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                outer.asked.append((self.command, self.path, self.headers.get("Authorization") or ""))
                given = (answer(self.command, self.path, dict(self.headers), body) for answer in outer.answers)
                status, headers, told = next(answer for answer in given if answer)
                self.send_response(status)
                for name, value in {"Content-Length": str(len(told)), **headers}.items():
                    self.send_header(name, value)
                self.end_headers()
                if self.command != "HEAD":
                    self.wfile.write(told)

            do_GET = do_HEAD = do_POST = do_PATCH = do_PUT = _answer

            def log_message(self, *_: Any) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.address = f"http://127.0.0.1:{self.server.server_address[1]}"
        threading.Thread(target=self.server.serve_forever, daemon=True).start()

    def _usual(self, method: str, path: str, headers: dict[str, str], body: bytes) -> Answer:
        last = path.rpartition("/")[2]
        if method == "POST":
            name = f"u{len(self.uploads)}"
            self.uploads[name] = b""
            return 202, {"Location": f"/v2/study/blobs/uploads/{name}?state=x"}, b""
        if method == "PATCH":
            self.uploads[last.partition("?")[0]] += body
            return 201, {}, b""  # as ECR does
        if method == "PUT" and "uploads" in path:
            name, _, digest = last.partition("?state=x&digest=")
            if digest_of(self.uploads[name]) != digest:
                return 400, {}, b'{"errors": [{"code": "DIGEST_INVALID"}]}'
            self.blobs[digest] = self.uploads[name]
            return 201, {}, b""
        if method == "PUT":
            self.manifests[last] = body
            return 201, {}, b""
        there = (self.blobs if "/blobs/" in path else self.manifests).get(last)
        return (200, {}, there) if there is not None else (404, {}, b"{}")

    def fails(self, times: int, when: str, status: int = 500, headers: dict[str, str] | None = None) -> None:
        """Answer the first requests with this method so."""
        left = [times]

        def answer(method: str, *_: Any) -> Answer | None:
            if method == when and left[0]:
                left[0] -= 1
                return status, headers or {}, b"not now"
            return None

        self.answers.insert(0, answer)


@pytest.fixture
def there(monkeypatch: pytest.MonkeyPatch) -> Iterator[Registry]:
    monkeypatch.setattr(registry, "PAUSES", (0, 0, 0))
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    found = Registry()
    yield found
    found.server.shutdown()
    found.server.server_close()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    (tmp_path / "layer").write_bytes(BODY)
    return tmp_path / "layer"


def test_a_blob_is_pushed_whole_and_pulled_again(there: Registry, file: Path, tmp_path: Path) -> None:
    repository, progress = Repository(there.address, "study", "secret"), []
    assert not repository.has(BLOB.digest)
    repository.push(BLOB, file, progress.append)
    assert there.blobs == {BLOB.digest: BODY}
    assert sum(progress) == BLOB.size
    assert repository.has(BLOB.digest)
    repository.pull(BLOB, tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == BODY
    assert {login for *_, login in there.asked} == {"Basic QVdTOnNlY3JldA=="}


@pytest.mark.parametrize("method", ["POST", "PATCH", "PUT"])
@pytest.mark.parametrize("status", [429, 500, 503])
def test_a_push_that_fails_for_a_while_begins_with_a_new_upload(
    there: Registry, file: Path, method: str, status: int
) -> None:
    there.fails(2, method, status)
    progress: list[int] = []
    Repository(there.address, "study").push(BLOB, file, progress.append)
    assert there.blobs == {BLOB.digest: BODY}
    assert [asked for asked, *_ in there.asked].count("POST") == 3
    assert sum(progress) == BLOB.size, "what a failed try has sent does not count"


def test_a_registry_that_stays_away_is_named(there: Registry, file: Path) -> None:
    there.fails(99, "POST", 503)
    with pytest.raises(Problem, match=r"127\.0\.0\.1:\d+ cannot be reached, or does not do its work: HTTP 503 not now"):
        Repository(there.address, "study").push(BLOB, file)
    there.server.server_close()
    with pytest.raises(Problem, match="cannot be reached"):
        Repository("http://127.0.0.1:9", "study").has(BLOB.digest)


def test_a_refusal_is_told_at_once(there: Registry, file: Path) -> None:
    there.fails(99, "POST", 403)
    with pytest.raises(Problem, match=r"refused a request for study \(HTTP 403\)") as caught:
        Repository(there.address, "study", "secret").push(BLOB, file)
    assert "hippodrome deploy" in caught.value.advice
    assert len(there.asked) == 1
    with pytest.raises(Problem) as caught:
        Repository(there.address, "study").push(BLOB, file)
    assert "--docker" in caught.value.advice, "a base that needs a login"


def test_a_damaged_blob_is_fetched_again_and_never_used(there: Registry, tmp_path: Path) -> None:
    there.blobs[BLOB.digest] = BODY[:-1] + b"!"
    with pytest.raises(Problem, match="was damaged on its way"):
        Repository(there.address, "study").pull(BLOB, tmp_path / "x")
    assert len(there.asked) == 4
    there.manifests[BLOB.digest] = b"{}"
    with pytest.raises(Problem, match="was damaged on its way"):
        Repository(there.address, "study").manifest(BLOB.digest)


def test_an_anonymous_token_is_asked_for_and_used(there: Registry, tmp_path: Path) -> None:
    there.blobs[BLOB.digest] = BODY

    def guard(method: str, path: str, headers: dict[str, str], body: bytes) -> Answer | None:
        if path.startswith("/token?"):
            assert path == "/token?service=here&scope=pull"
            return 200, {}, b'{"token": "abc"}'
        if headers.get("Authorization") != "Bearer abc":
            challenge = f'Bearer realm="{there.address}/token",service="here",scope="pull"'
            return 401, {"WWW-Authenticate": challenge}, b""
        return None

    there.answers.insert(0, guard)
    repository = Repository(there.address, "study")
    assert repository.has(BLOB.digest)
    repository.pull(BLOB, tmp_path / "x")
    assert [path.partition("?")[0] for _, path, _ in there.asked].count("/token") == 1


def test_a_login_does_not_follow_to_another_host(
    there: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Registries keep their blobs elsewhere: ECR at S3, AWS's public mirror at CloudFront."""
    monkeypatch.setenv("NO_PROXY", "127.0.0.1,localhost")
    elsewhere = Registry()
    elsewhere.blobs[BLOB.digest] = BODY
    host = elsewhere.address.replace("127.0.0.1", "localhost")
    there.fails(1, "GET", 307, {"Location": f"{host}/v2/study/blobs/{BLOB.digest}"})
    Repository(there.address, "study", "secret").pull(BLOB, tmp_path / "x")
    assert there.asked[0][2]
    assert elsewhere.asked == [("GET", f"/v2/study/blobs/{BLOB.digest}", "")]
    elsewhere.server.shutdown()
    elsewhere.server.server_close()


def test_a_login_of_netrc_is_not_used(there: Registry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "netrc").write_text("machine 127.0.0.1 login me password mine\n")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    Repository(there.address, "study").has(BLOB.digest)
    assert there.asked == [("HEAD", f"/v2/study/blobs/{BLOB.digest}", "")]


def test_the_variant_for_linux_on_x86_64_is_chosen(there: Registry) -> None:
    inner = json.dumps({"schemaVersion": 2, "layers": []}).encode()
    digest = digest_of(inner)
    platforms = [
        ("linux", "arm64", "sha256:" + "0" * 64),
        ("unknown", "unknown", "sha256:" + "1" * 64),
        ("linux", "amd64", digest),
    ]
    listed = [
        {"digest": each, "platform": {"os": system, "architecture": machine}} for system, machine, each in platforms
    ]
    there.manifests["3.13"] = json.dumps({"manifests": listed}).encode()
    there.manifests[digest] = inner
    assert Repository(there.address, "study").manifest("3.13") == (digest, {"schemaVersion": 2, "layers": []})
    there.manifests["3.13"] = json.dumps({"manifests": listed[:2]}).encode()
    with pytest.raises(Problem, match="has no variant for Linux on x86-64"):
        Repository(there.address, "study").manifest("3.13")


def test_a_manifest_is_pushed_as_it_is_named(there: Registry) -> None:
    digest = Repository(there.address, "study").tag("maze-1", {"b": 1, "a": 2})
    assert there.manifests["maze-1"] == b'{"a":2,"b":1}'
    assert digest == f"sha256:{hashlib.sha256(there.manifests['maze-1']).hexdigest()}"


def test_names_of_images_are_read_as_docker_reads_them() -> None:
    digest = "sha256:" + "a" * 64
    hub = "https://registry-1.docker.io"
    assert place_of("python") == Place(hub, "library/python", "latest")
    assert place_of("me/python:3.13") == Place(hub, "me/python", "3.13")
    assert place_of("public.ecr.aws/docker/library/python:3.13-slim-trixie") == Place(
        "https://public.ecr.aws", "docker/library/python", "3.13-slim-trixie"
    )
    assert place_of(f"mirror.example:5000/python:3.13@{digest}") == Place(
        "https://mirror.example:5000", "python", digest
    )
    assert place_of("localhost:5000/python:3.13") == Place("http://localhost:5000", "python", "3.13")
