"""Assembles an image without Docker, and pushes it: the base's layers as they are, and four of our own.

The trial's packages | the study's own | Hippodrome | the study. Each layer is made once from the same inputs, and sent
only if the repository does not have it: after a change of agent.py that is some kilobytes.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import DownloadColumn

from hippodrome.console import formatting, screen
from hippodrome.console.problem import Problem
from hippodrome.control.ports import PORTS
from hippodrome.deployment.code import bytecode
from hippodrome.deployment.code.packages import cache_folder
from hippodrome.deployment.study.definition import SCRATCH, USER
from hippodrome.deployment.study.image import packages, tried
from hippodrome.deployment.study.image.bundle import Bundle
from hippodrome.deployment.study.image.layers import OCI, Blob, Files, Folder, Layer, layer
from hippodrome.deployment.study.image.order import Order
from hippodrome.deployment.study.image.registry import (
    MANIFEST,
    Progress,
    Repository,
    canonical,
    digest_of,
    place_of,
)
from hippodrome.protocol import environment

KEPT_DAYS = 60  # days for which the cache keeps what is not used
_MADE = "1970-01-01T00:00:00Z"  # the same image at any time
ENV = {
    "PYTHONUNBUFFERED": "1",
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONSAFEPATH": "1",
    "PYTHONPATH": "/hippodrome",
    "PYTHONUSERBASE": f"/{packages.BASE}",
    environment.AGENT_DIR: "/project",
    "HOME": SCRATCH,
    "TMPDIR": SCRATCH,
    # /etc/passwd is the base's, without a line for the user
    "USER": "trial",
    "LOGNAME": "trial",
}


@dataclass(frozen=True)
class Base:
    """The image on which ours is built: where it comes from, its manifest and its config."""

    name: str
    digest: str
    manifest: Mapping[str, Any]
    config: Mapping[str, Any]

    @property
    def layers(self) -> list[dict[str, Any]]:
        """The descriptors of its layers, with OCI's media types: manifests that mix Docker's in are refused."""
        kinds = {"application/vnd.docker.image.rootfs.diff.tar.gzip": f"{OCI}.layer.v1.tar+gzip"}
        keys = ("digest", "size")
        return [
            {"mediaType": kinds.get(layer["mediaType"], layer["mediaType"]), **{key: layer[key] for key in keys}}
            for layer in self.manifest["layers"]
        ]


def build(order: Order) -> None:
    """Assemble the image, try the agent with its packages, and push it. Raises `Problem` if one of these fails."""
    cache = cache_folder() / "image"
    cache.mkdir(parents=True, exist_ok=True)
    base = find_base(order.bundle.base, cache, fresh=order.fresh)
    installed = packages.install(order.bundle.requirements, cache, fresh=order.fresh)
    tried.agent(order.bundle, [layer_installed.folder for layer_installed in installed])
    layers = make_layers(order.bundle, installed, cache)
    target = Repository(order.repository.address, order.repository.name, order.repository.password())
    push(target, order.tag, base, layers)
    prune(cache)


def find_base(name: str, cache: Path, *, fresh: bool = False) -> Base:
    """Return the base image of this name. It stays the same until `fresh`: a change of agent.py is no other Python."""
    cached = cache / "bases" / f"{digest_of(name.encode())[7:]}.json"
    if fresh or not cached.is_file():
        place = place_of(name)
        source = Repository(place.address, place.repository)
        digest, manifest = source.manifest(place.reference)
        with tempfile.TemporaryDirectory(dir=cache, prefix="coming-") as coming:
            file = Path(coming, "config")
            source.pull(Blob(manifest["config"]["digest"], manifest["config"]["size"]), file)
            config = json.loads(file.read_bytes())
            cached.parent.mkdir(exist_ok=True)
            file.write_bytes(canonical({"name": name, "digest": digest, "manifest": manifest, "config": config}))
            os.replace(file, cached)
    os.utime(cached)
    base = Base(**json.loads(cached.read_bytes()))
    version = _variables(base.config).get("PYTHON_VERSION", packages.PYTHON)  # set by Docker's official images
    if not f"{version}.".startswith(f"{packages.PYTHON}."):
        raise Problem(
            f"The base image {name} has Python {version}, and the trial needs Python {packages.PYTHON}.",
            "Name another with --base.",
        )
    return base


def make_layers(bundle: Bundle, installed: list[packages.Packages], cache: Path) -> list[Layer]:
    """Return our layers, in their order: first what changes least."""
    store = cache / "layers"
    layers = [layer(package.name, package.key, store, partial(_files_of, package)) for package in installed]
    scratch = Folder(0o700, int(USER.partition(":")[0]))
    ours = Files(_with_bytecode(bundle.below("hippodrome")), {SCRATCH[1:]: scratch})
    study = Files({**bundle.below("project"), "project/requirements.txt": bundle.requirements.encode()})
    return [
        *layers,
        layer("Hippodrome", ours.hash, store, lambda: ours),
        layer("the study", study.hash, store, lambda: study),
    ]


def _files_of(installed: packages.Packages) -> Files:
    return Files(installed.entries)


def _with_bytecode(entries: Mapping[str, Path | bytes]) -> dict[str, Path | bytes]:
    """Return our own modules by their paths in the image, with bytecode if this machine has the image's Python."""
    sources = {name: entry if isinstance(entry, bytes) else entry.read_bytes() for name, entry in entries.items()}
    python = bytecode.compiler(packages.PYTHON)
    bytecode_files = bytecode.compiled(sources, python, "/hippodrome") if python else {}
    return {f"hippodrome/{name}": body for name, body in {**sources, **bytecode_files}.items()}


def configure(base: Base, layers: list[Layer]) -> bytes:
    """Write the image's config: the base's, with our user, variables, volume and command."""
    theirs = base.config.get("config") or {}
    ours = {
        "Env": [f"{name}={value}" for name, value in {**_variables(base.config), **ENV}.items()],
        "User": USER,
        "WorkingDir": "/project",
        "Volumes": {**(theirs.get("Volumes") or {}), SCRATCH: {}},
        "ExposedPorts": {f"{port}/tcp": {} for port in PORTS},
        "StopSignal": "SIGTERM",
        "Cmd": ["python", "-m", "hippodrome.trial"],
        "Labels": {
            **(theirs.get("Labels") or {}),
            "org.opencontainers.image.base.name": base.name,
            "org.opencontainers.image.base.digest": base.digest,
        },
    }
    history = [{"created": _MADE, "created_by": f"hippodrome register: {layer.name}"} for layer in layers]
    return canonical(
        {
            "architecture": "amd64",
            "os": "linux",
            "created": _MADE,
            "config": {**theirs, **ours},
            "rootfs": {
                "type": "layers",
                "diff_ids": [*base.config["rootfs"]["diff_ids"], *(i.diff_id for i in layers)],
            },
            "history": [*(base.config.get("history") or []), *history],
        }
    )


def push(target: Repository, tag: str, base: Base, layers: list[Layer]) -> str:
    """Push what the repository lacks, one layer after the other, the manifest last. Return the image's digest."""
    config = configure(base, layers)
    blob = Blob(digest_of(config), len(config))
    with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
        file = Path(folder, "blob")
        _push_base(target, base, file)
        for each in layers:
            new = not target.has(each.digest)
            if new:
                _with_bar(f"Sending {each.name}", each.size, partial(target.push, each.blob, each.file))
            _tell(each.name, each.size, new)
        file.write_bytes(config)
        if not target.has(blob.digest):
            target.push(blob, file)
    return target.tag(
        tag,
        {
            "schemaVersion": 2,
            "mediaType": MANIFEST,
            "config": {"mediaType": f"{OCI}.config.v1+json", "digest": blob.digest, "size": blob.size},
            "layers": [*base.layers, *(layer.descriptor for layer in layers)],
        },
    )


def _push_base(target: Repository, base: Base, file: Path) -> None:
    """Send the layers of the base that the repository lacks, by way of the file."""
    blobs = [Blob(layer["digest"], layer["size"]) for layer in base.layers]
    missing = [blob for blob in blobs if not target.has(blob.digest)]
    place = place_of(base.name)
    source = Repository(place.address, place.repository)
    for blob in missing:
        _with_bar("Fetching a layer of the base", blob.size, partial(source.pull, blob, file))
        _with_bar("Sending it", blob.size, partial(target.push, blob, file))
    _tell("the base", sum(blob.size for blob in blobs), bool(missing))


def _variables(config: Mapping[str, Any]) -> dict[str, str]:
    listed = (config.get("config") or {}).get("Env") or [
        "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
    ]
    return dict(variable.split("=", 1) for variable in listed)


def _with_bar(what: str, size: int, work: Callable[[Progress], None]) -> None:
    with screen.ProgressBars(amount=DownloadColumn()) as bars:
        task = bars.add_task(what, total=size)
        work(lambda more: bars.advance(task, more))


def _tell(name: str, size: int, new: bool) -> None:
    screen.info(f"  {name:<22}{formatting.size(size):>10}  {'sent' if new else 'there already'}")


def prune(cache: Path) -> None:
    """Remove what has not been used for long: packages such as torch take gigabytes."""
    old = time.time() - KEPT_DAYS * 86400
    for path in cache.glob("*/*"):
        if path.stat().st_mtime < old:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)
