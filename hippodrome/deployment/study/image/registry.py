"""A repository of images by the OCI distribution protocol: pulls a base, pushes layers, a config and a manifest.

Sources: OCI Distribution Specification 1.1; distribution.github.io/distribution/spec/auth for tokens. A blob is pushed
as docker does it: POST, one PATCH with the whole blob, PUT. ECR answers a PATCH with 201 instead of 202
(aws/containers-roadmap, issue 2831), and refuses to go on with an upload that was broken off (apple/containerization,
issue 790): so each 2xx counts, and every try is an upload of its own.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple, TypeVar
from urllib.parse import urljoin, urlsplit

import requests

from hippodrome.console.problem import Problem
from hippodrome.deployment.study.image.layers import OCI, Blob

PAUSES = (1.0, 2.0, 4.0, 8.0)  # seconds between tries
DOCKER = "application/vnd.docker"
MANIFEST = f"{OCI}.manifest.v1+json"

_INDEXES = {f"{OCI}.index.v1+json", f"{DOCKER}.distribution.manifest.list.v2+json"}
_ACCEPT = ", ".join([MANIFEST, f"{DOCKER}.distribution.manifest.v2+json", *sorted(_INDEXES)])
_TIMES = (10, 60)  # seconds for connecting, and between two bytes
_CHUNK = 1024 * 1024
_NAME = re.compile(r"(?:(?P<host>[^/]+)/)?(?P<path>[^@:]+)(?::(?P<tag>[^@]+))?(?:@(?P<digest>sha256:[0-9a-f]{64}))?")
_HUB = "registry-1.docker.io"
_T = TypeVar("_T")

Progress = Callable[[int], None]
"""Is told how many bytes have been sent or received since the last call."""


class Place(NamedTuple):
    """Where an image is: the registry's address, the repository, and a tag or digest."""

    address: str
    repository: str
    reference: str


def place_of(image: str) -> Place:
    """Read an image's name as docker does: `python:3.13` is Docker Hub's; only this machine is asked without TLS."""
    parts = _NAME.fullmatch(image)
    assert parts, "checked by make_bundle"
    host, path = parts["host"] or "", parts["path"]
    if not re.search(r"[.:]|^localhost$", host):
        host, path = _HUB, f"{host or 'library'}/{path}"
    loopback = host.partition(":")[0] in {"127.0.0.1", "localhost"}
    return Place(f"{'http' if loopback else 'https'}://{host}", path, parts["digest"] or parts["tag"] or "latest")


def digest_of(body: bytes) -> str:
    """Return the digest by which a registry names these bytes."""
    return f"sha256:{hashlib.sha256(body).hexdigest()}"


class Repository:
    """A repository of a registry. `password` is that of ECR's user AWS; without one, the registry is asked anonymously.

    Every call tries again if the registry is busy or the network fails. Raises `Problem` if it does not succeed.
    """

    def __init__(self, address: str, name: str, password: str = "") -> None:
        self.address, self.name = address.rstrip("/"), name
        self._session = requests.Session()
        self._session.auth = _unchanged  # or requests would take a login from ~/.netrc
        self._ours = bool(password)
        self._login = f"Basic {base64.b64encode(f'AWS:{password}'.encode()).decode()}" if password else ""

    def manifest(self, reference: str) -> tuple[str, dict[str, Any]]:
        """Return the digest and the manifest of the image for Linux on x86-64."""

        def get() -> tuple[str, dict[str, Any]]:
            answer = self._ask("GET", f"manifests/{reference}", headers={"Accept": _ACCEPT})
            digest = digest_of(answer.content)
            if reference.startswith("sha256:") and digest != reference:
                raise _Again(f"{reference} was damaged on its way")
            return digest, answer.json()

        digest, document = self._until_done(get)
        if "manifests" not in document:
            return digest, document
        for entry in document["manifests"]:
            platform = entry.get("platform", {})
            if (platform.get("os"), platform.get("architecture")) == ("linux", "amd64"):
                return self.manifest(entry["digest"])
        raise Problem(
            f"The base image {self.name}:{reference} has no variant for Linux on x86-64.", "Name another with --base."
        )

    def pull(self, blob: Blob, file: Path, progress: Progress | None = None) -> None:
        """Write the blob to the file."""

        def get() -> None:
            got = hashlib.sha256()
            answer = self._ask("GET", f"blobs/{blob.digest}", headers={"Accept-Encoding": "identity"}, stream=True)
            with answer, file.open("wb") as out, _Counted(progress) as count:
                for chunk in answer.iter_content(_CHUNK):
                    got.update(chunk)
                    out.write(chunk)
                    count(len(chunk))
                if f"sha256:{got.hexdigest()}" != blob.digest:
                    raise _Again(f"{blob.digest} was damaged on its way")

        self._until_done(get)

    def has(self, digest: str) -> bool:
        """Whether the repository has the blob."""
        return self._until_done(lambda: self._ask("HEAD", f"blobs/{digest}", missing=True)).status_code != 404

    def push(self, blob: Blob, file: Path, progress: Progress | None = None) -> None:
        """Push the file as this blob."""
        octets = {"Content-Type": "application/octet-stream"}

        def put() -> None:
            where = self._ask("POST", "blobs/uploads/").headers["Location"]
            with file.open("rb") as body, _Counted(progress) as count:
                answer = self._ask("PATCH", where, headers=octets, data=_Body(body, blob.size, count))
                where = answer.headers.get("Location", where)
                self._ask("PUT", f"{where}{'&' if '?' in where else '?'}digest={blob.digest}", headers=octets)

        self._until_done(put)

    def tag(self, tag: str, manifest: Mapping[str, Any]) -> str:
        """Push the manifest under this tag, and return its digest. Its blobs have to be there."""
        body = canonical(manifest)
        headers = {"Content-Type": MANIFEST}
        self._until_done(lambda: self._ask("PUT", f"manifests/{tag}", headers=headers, data=body))
        return digest_of(body)

    def _until_done(self, work: Callable[[], _T]) -> _T:
        for pause in (*PAUSES, None):
            try:
                return work()
            except _PASSING as error:
                if pause is None:
                    raise Problem(
                        f"{self._host} cannot be reached, or does not do its work: {_words(error)}.",
                        "Check the network, and run the same command again: layers that are there are not sent again.",
                    ) from None
                time.sleep(pause)
        raise AssertionError("the loop returns or raises")

    def _ask(
        self, method: str, path: str, headers: Mapping[str, str] | None = None, missing: bool = False, **options: Any
    ) -> requests.Response:
        """Send a request to a path below the repository, or to an address that an answer named.

        With `missing`, a 404 is an answer, too.
        """
        url = urljoin(f"{self.address}/v2/{self.name}/", path)
        own = urlsplit(url).netloc == urlsplit(self.address).netloc
        for fresh in (False, True):
            login = {"Authorization": self._login} if self._login and own else {}
            answer = self._session.request(
                method, url, headers={**(headers or {}), **login}, timeout=_TIMES, allow_redirects=True, **options
            )  # on its way to another host, requests takes the Authorization away
            challenge = answer.headers.get("WWW-Authenticate", "")
            if answer.status_code != 401 or fresh or not challenge.lower().startswith("bearer "):
                break
            self._login = self._token(challenge)
        if answer.ok or (missing and answer.status_code == 404):
            return answer
        text = answer.text[:300] if method != "HEAD" else ""
        if answer.status_code in {408, 429} or answer.status_code >= 500:
            raise _Again(f"HTTP {answer.status_code} {text}")
        raise self._refused(answer.status_code, text)

    def _token(self, challenge: str) -> str:
        """Ask for an anonymous token, as the challenge says."""
        part = dict(re.findall(r'(\w+)="([^"]*)"', challenge))
        query = {key: part[key] for key in ("service", "scope") if key in part}
        answer = self._session.get(part["realm"], params=query, timeout=_TIMES)
        if not answer.ok:
            raise _Again(f"HTTP {answer.status_code} for a token")
        document = answer.json()
        return f"Bearer {document.get('token') or document['access_token']}"

    def _refused(self, status: int, text: str) -> Problem:
        what = f"{self._host} refused a request for {self.name} (HTTP {status})."
        advice = (
            "Run it again. If it fails again, ask the administrator to run `hippodrome deploy`."
            if self._ours
            else "Correct the name of the base. If it needs a login, add --docker: the builder knows your logins."
        )
        return Problem(what, advice, [" ".join(text.split())] if text else [])

    @property
    def _host(self) -> str:
        return urlsplit(self.address).netloc


def canonical(document: Mapping[str, Any]) -> bytes:
    """Write a config or manifest: the same content makes the same bytes."""
    return json.dumps(document, separators=(",", ":"), sort_keys=True).encode()


class _Again(Exception):
    """The registry may do it if it is asked again."""


_PASSING = (_Again, requests.ConnectionError, requests.Timeout, requests.exceptions.ChunkedEncodingError)


class _Counted:
    """Tells the progress of a try, and takes it back if the try fails."""

    def __init__(self, progress: Progress | None) -> None:
        self._progress, self._done = progress or (lambda _: None), 0

    def __call__(self, size: int) -> None:
        self._done += size
        self._progress(size)

    def __enter__(self) -> _Counted:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self._progress(-self._done)


class _Body:
    """A file as the body of a request. Its length is known, or requests would send it in chunks."""

    def __init__(self, file: IO[bytes], size: int, count: Progress) -> None:
        self._file, self._size, self._count = file, size, count

    def __len__(self) -> int:
        return self._size

    def __iter__(self) -> Iterator[bytes]:
        while chunk := self._file.read(_CHUNK):
            self._count(len(chunk))
            yield chunk


def _unchanged(request: requests.PreparedRequest) -> requests.PreparedRequest:
    return request


def _words(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
