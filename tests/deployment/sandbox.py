"""Runs images without Docker: a registry, bases of Debian trixie, and bubblewrap, all from Debian's packages."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import os
import shutil
import subprocess
import tarfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import pip
import requests

from hippodrome.deployment.code.packages import cache_folder
from hippodrome.deployment.study.image.layers import OCI, Blob
from hippodrome.deployment.study.image.registry import Repository, canonical, digest_of

PROGRAMS = {
    "docker-registry": "docker-registry",
    "mmdebstrap": "mmdebstrap",
    "bwrap": "bubblewrap",
    "setpriv": "util-linux",
}
DOCKER = "application/vnd.docker"
DOCKERS = tuple(
    f"{DOCKER}.{kind}"
    for kind in ("distribution.manifest.v2+json", "container.image.v1+json", "image.rootfs.diff.tar.gzip")
)
OCIS = tuple(f"{OCI}.{kind}" for kind in ("manifest.v1+json", "config.v1+json", "layer.v1.tar+gzip"))

# The base has apt and the essential packages, as Debian's official images, and these; no documents and translations.
_INCLUDED = ("python3.13", "ca-certificates", "openssl", "passwd")
_PATHS = (f"--dpkgopt=path-exclude=/usr/share/{name}/*" for name in ("doc", "man", "locale", "info"))
_RECIPE = ("--variant=apt", f"--include={','.join(_INCLUDED)}", *_PATHS)


def missing(*programs: str) -> str:
    """Say what these tests lack on this machine; "" if nothing."""
    lacking = [PROGRAMS.get(name, name) for name in (*PROGRAMS, *programs) if shutil.which(name) is None]
    if lacking:
        return f"Images run only where these are installed: apt-get install {' '.join(lacking)}"
    if os.geteuid() != 0:
        return "Images run only for root: their files belong to users, and setpriv changes to one"
    probe = ["bwrap", "--unshare-user", "--unshare-pid", "--ro-bind", "/", "/", "true"]
    if subprocess.run(probe, capture_output=True, check=False).returncode:
        return "Images run only where user namespaces may be made, which this container forbids"
    try:
        debian()
    except subprocess.CalledProcessError:
        return "Images need a base, and none could be made from Debian's mirror"
    return ""


@contextlib.contextmanager
def registry(folder: Path, port: int) -> Iterator[str]:
    """Serve Debian's docker-registry on loopback. Yield its address without `http://`."""
    folder.mkdir()
    host = f"127.0.0.1:{port}"
    settings = {
        "version": 0.1,
        "log": {"level": "warn"},
        "storage": {"filesystem": {"rootdirectory": str(folder / "data")}},
        "http": {"addr": host},
    }
    (folder / "registry.yml").write_text(json.dumps(settings))
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(["docker-registry", "serve", str(folder / "registry.yml")], stdout=log, stderr=log)
    try:
        _until_it_answers(f"http://{host}/v2/", process)
        yield host
    finally:
        process.terminate()
        process.wait()


def _until_it_answers(address: str, process: subprocess.Popen[bytes]) -> None:
    for _ in range(600):
        assert process.poll() is None, "the registry has ended"
        with contextlib.suppress(requests.ConnectionError):
            requests.get(address, timeout=10, proxies={"http": ""})
            return
        time.sleep(0.05)
    raise AssertionError("the registry does not answer")


def debian() -> Path:
    """Return a tar of Debian trixie with Python 3.13. It is made once on a machine, which takes a minute."""
    place = cache_folder() / "tests" / f"trixie-{digest_of(repr(_RECIPE).encode())[7:19]}.tar"
    if not place.is_file():
        place.parent.mkdir(parents=True, exist_ok=True)
        part = place.with_suffix(f".{os.getpid()}.tar")
        subprocess.run(["mmdebstrap", "--quiet", *_RECIPE, "trixie", str(part)], check=True)
        part.replace(place)
    return place


def push_debian(address: str, name: str, folder: Path) -> str:
    """Push the base as Debian lays it out: Python in /usr/bin, an OCI manifest. Return the image's name."""
    body = _repacked({"usr/bin/python": "python3.13"}, {})
    return _push(Repository(f"http://{address}", name), body, folder, {"PATH": "/usr/bin:/bin"})


def push_official(address: str, name: str, folder: Path, version: str = "3.13.5") -> str:
    """Push the base as Docker's official image is: Python in /usr/local, an index, media types of Docker."""
    moved = {f"usr/{path}": f"usr/local/{path}" for path in ("lib/python3.13", "bin/python3.13")}
    body = _repacked({"usr/local/bin/python": "python3.13"}, moved, {"usr/local/bin/pip": _PIP, **_pip()})
    variables = {"PATH": "/usr/local/bin:/usr/local/sbin:/usr/sbin:/usr/bin:/sbin:/bin", "PYTHON_VERSION": version}
    return _push(Repository(f"http://{address}", name), body, folder, variables, official=True)


_PIP = b"#!/usr/local/bin/python\nimport sys\nfrom pip._internal.cli.main import main\nsys.exit(main())\n"


def _pip() -> dict[str, bytes]:
    """Return the files of this machine's pip, as they lie in the official image."""
    folder = Path(pip.__file__).parent
    files = [*folder.rglob("*"), *folder.parent.glob("pip-*.dist-info/*")]
    return {
        f"usr/local/lib/python3.13/dist-packages/{path.relative_to(folder.parent).as_posix()}": path.read_bytes()
        for path in files
        if path.is_file() and path.suffix != ".pyc"
    }


def _repacked(links: Mapping[str, str], moved: Mapping[str, str], files: Mapping[str, bytes] | None = None) -> bytes:
    """Pack Debian's files anew, with these links and files beside them, and without devices and apt's lists."""

    def place(path: str) -> str:
        path = path.removeprefix("./").rstrip("/")
        old = next((old for old in moved if path == old or path.startswith(f"{old}/")), "")
        return moved[old] + path.removeprefix(old) if old else path

    out, known = io.BytesIO(), {""}  # /usr/local has its folder for Python already
    with tarfile.open(debian()) as debians, tarfile.open(fileobj=out, mode="w", format=tarfile.GNU_FORMAT) as tar:
        for info in debians:
            info.name = place(info.name)
            needless = info.isdev() or info.name.startswith(("dev/", "var/cache/", "var/lib/apt/"))
            # Docker's Python has no such file: it lets pip install.
            if info.name not in known and not needless and not info.name.endswith("/EXTERNALLY-MANAGED"):
                known.add(info.name)
                body = debians.extractfile(info) if info.isreg() else None
                if info.islnk():
                    info.linkname = place(info.linkname)
                tar.addfile(info, body)
        for name, content in (files or {}).items():
            member = tarfile.TarInfo(name)
            member.size, member.mode = len(content), 0o755
            tar.addfile(member, io.BytesIO(content))
        for name, target in links.items():
            link = tarfile.TarInfo(name)
            link.type, link.linkname = tarfile.SYMTYPE, target
            tar.addfile(link)
    return out.getvalue()


def _push(there: Repository, body: bytes, folder: Path, variables: Mapping[str, str], *, official: bool = False) -> str:
    """Push an image of one layer with the tag 3.13."""
    config = canonical(
        {
            "architecture": "amd64",
            "os": "linux",
            "config": {"Env": [f"{name}={value}" for name, value in variables.items()], "Cmd": ["python3"]},
            "rootfs": {"type": "layers", "diff_ids": [digest_of(body)]},
            "history": [{"created_by": "debian"}],
        }
    )
    kinds = DOCKERS if official else OCIS
    descriptors = []
    for kind, content in zip(kinds[1:], (config, gzip.compress(body, 1, mtime=0)), strict=True):
        blob = Blob(digest_of(content), len(content))
        (folder / "blob").write_bytes(content)
        there.push(blob, folder / "blob")
        descriptors.append({"mediaType": kind, "digest": blob.digest, "size": blob.size})
    manifest = {"schemaVersion": 2, "mediaType": kinds[0], "config": descriptors[0], "layers": descriptors[1:]}
    if official:
        digest = digest_of(canonical(manifest))
        _put(there, manifest, digest)
        entry = {"mediaType": kinds[0], "digest": digest, "size": len(canonical(manifest))}
        platforms = ({"architecture": "unknown", "os": "unknown"}, {"architecture": "amd64", "os": "linux"})
        kind = f"{DOCKER}.distribution.manifest.list.v2+json"
        index = [{**entry, "platform": platform} for platform in platforms]
        manifest = {"schemaVersion": 2, "mediaType": kind, "manifests": index}
    _put(there, manifest, "3.13")
    return f"{there.address.removeprefix('http://')}/{there.name}:3.13"


def _put(there: Repository, document: Mapping[str, Any], reference: str) -> None:
    answer = requests.put(
        f"{there.address}/v2/{there.name}/manifests/{reference}",
        canonical(document),
        headers={"Content-Type": document["mediaType"]},
        timeout=30,
    )
    assert answer.ok, answer.text


def buildahs_settings(folder: Path, address: str) -> dict[str, str]:
    """Return variables with which Buildah builds here as root, in a folder of its own, without user namespaces.

    The registry speaks plain HTTP, and what runs in a build trusts the certificates that this machine trusts.
    """
    folder.mkdir()
    trusted = "/etc/ssl/certs"
    texts = {
        "registries.conf": f'[[registry]]\nlocation = "{address}"\ninsecure = true\n',
        "storage.conf": f'[storage]\ndriver = "vfs"\ngraphroot = "{folder}/graph"\nrunroot = "{folder}/run"\n',
        "policy.json": '{"default": [{"type": "insecureAcceptAnything"}]}',
        "containers.conf": f'[containers]\nvolumes = ["{trusted}:{trusted}:ro"]\nenv = ["PIP_DEFAULT_TIMEOUT=180"]\n',
        "auth.json": "{}",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return {
        "BUILDAH_ISOLATION": "chroot",
        "CONTAINERS_REGISTRIES_CONF": str(folder / "registries.conf"),
        "CONTAINERS_STORAGE_CONF": str(folder / "storage.conf"),
        "CONTAINERS_CONF": str(folder / "containers.conf"),
        "REGISTRY_AUTH_FILE": str(folder / "auth.json"),
    }


def unpack(address: str, name: str, tag: str, root: Path) -> dict[str, Any]:
    """Pull the image and unpack it, as a container engine does, with its owners. Return its config."""
    there = Repository(f"http://{address}", name)
    _, manifest = there.manifest(tag)
    root.mkdir()
    file = root.with_suffix(".blob")
    for layer in manifest["layers"]:
        there.pull(Blob(layer["digest"], layer["size"]), file)
        with tarfile.open(file) as tar:
            tar.extraction_filter = lambda member, _: member  # owners and modes as they are
            for info in tar:
                assert not PurePosixPath(info.name).name.startswith(".wh."), "no layer takes anything away"
                tar.extract(info, root, numeric_owner=True)
    there.pull(Blob(manifest["config"]["digest"], manifest["config"]["size"]), file)
    config: dict[str, Any] = json.loads(file.read_bytes())["config"]
    file.unlink()
    return config


def start(root: Path, config: Mapping[str, Any], variables: Mapping[str, str], log: Path) -> subprocess.Popen[bytes]:
    """Run the image as Fargate does: as its user, with a read-only root, no capability, and its volume alone writable."""
    user, group = config["User"].split(":")
    # setpriv first: in a user namespace of bwrap's own, files of root would seem to be the user's.
    command = ["setpriv", "--reuid", user, "--regid", group, "--clear-groups", "--no-new-privs"]
    command += ["--bounding-set=-all", "--inh-caps=-all"]
    command += ["bwrap", "--unshare-user", "--unshare-pid", "--unshare-ipc", "--die-with-parent", "--as-pid-1"]
    command += ["--ro-bind", str(root), "/", "--proc", "/proc", "--dev", "/dev"]
    for volume in config["Volumes"]:
        command += ["--perms", "0700", "--tmpfs", volume]
    command += ["--chdir", config["WorkingDir"], "--clearenv"]
    environment = {**dict(each.split("=", 1) for each in config["Env"]), **variables}
    for name, value in environment.items():
        command += ["--setenv", name, value]
    with log.open("wb") as out, log.with_suffix(".err").open("wb") as errors:
        return subprocess.Popen([*command, "--", *config["Cmd"]], stdout=out, stderr=errors)


def inside(root: Path, config: Mapping[str, Any], command: Sequence[str], log: Path) -> str:
    """Run a command in the image, and return what it prints."""
    process = start(root, {**config, "Cmd": command}, {}, log)
    assert process.wait(60) == 0, log.with_suffix(".err").read_text()
    return log.read_text()
