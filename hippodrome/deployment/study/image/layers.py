"""The layers of an image: files as a tar whose bytes depend only on names, bytes and permissions, compressed by gzip.

A layer is kept in the cache under a hash of what it is made from, and is made only once. Its digest may differ between
machines with another zlib, while its `diff_id`, the digest before compression, does not.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import stat
import struct
import tarfile
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePosixPath
from typing import IO, Any, cast

OCI = "application/vnd.oci.image"  # the beginning of media types

_CHUNK = 1024 * 1024
_LEVEL = 6
_HEADER = b"\x1f\x8b\x08\0\0\0\0\0\0\xff"  # no name, no time; gzip's own names the system differently in each Python


@dataclass(frozen=True)
class Blob:
    """What a registry keeps under its digest, with its size in bytes."""

    digest: str
    size: int


@dataclass(frozen=True)
class Folder:
    """The permissions and the owner of a folder that are not 0755 and root."""

    mode: int
    owner: int  # user and group


@dataclass(frozen=True)
class Files:
    """The content of a layer: files by their paths in the image (bytes, or a file of this machine), and folders."""

    entries: Mapping[str, Path | bytes]
    folders: Mapping[str, Folder] = field(default_factory=dict)

    @property
    def hash(self) -> str:
        """A digest that depends only on names, permissions and bytes."""
        text = f"{hash_of(self.entries)}{sorted(self.folders.items())}"
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Layer:
    """A compressed layer in a file. `raw` is its size before compression."""

    name: str
    file: Path
    digest: str
    diff_id: str
    size: int
    raw: int

    @property
    def blob(self) -> Blob:
        return Blob(self.digest, self.size)

    @property
    def descriptor(self) -> dict[str, Any]:
        return {"mediaType": f"{OCI}.layer.v1.tar+gzip", "digest": self.digest, "size": self.size}


def layer(name: str, key: str, cache: Path, content: Callable[[], Files]) -> Layer:
    """Return the layer that was made under this key, or make it. `content` says what it holds."""
    cache.mkdir(parents=True, exist_ok=True)
    file, facts = cache / f"{key}.tar.gz", cache / f"{key}.json"
    if not (facts.is_file() and file.is_file()):
        with tempfile.TemporaryDirectory(dir=cache, prefix="coming-") as coming:
            written = _write(name, Path(coming, "layer"), content())
            os.replace(written.file, file)
            known = {key: value for key, value in asdict(written).items() if key not in {"name", "file"}}
            Path(coming, "facts").write_text(json.dumps(known))
            os.replace(Path(coming, "facts"), facts)  # last: where the facts are, the layer is whole
    for path in (file, facts):
        os.utime(path)  # what has not been used for long is removed from the cache
    return Layer(name, file, **json.loads(facts.read_text()))


def _write(name: str, file: Path, files: Files) -> Layer:
    with file.open("wb") as out:
        sink = _Gzip(out)
        with tarfile.open(
            fileobj=cast(IO[bytes], sink),
            mode="w|",
            format=tarfile.GNU_FORMAT,
            encoding="utf-8",
            errors="surrogateescape",
        ) as archive:
            for info, entry in _members(files):
                with opened(entry) as body:
                    archive.addfile(info, body)
        sink.finish()
    return Layer(name, file, sink.digest, sink.diff_id, file.stat().st_size, sink.raw)


def _members(files: Files) -> Iterator[tuple[tarfile.TarInfo, Path | bytes]]:
    """Yield each file after the folders above it, in the order of their names."""
    folders = {"."}
    for name in sorted([*files.entries, *files.folders]):
        path = PurePosixPath(name)
        above = [*reversed(path.parents), *([path] if name in files.folders else [])]
        for folder in map(str, above):
            if folder not in folders:
                folders.add(folder)
                place = files.folders.get(folder, Folder(0o755, 0))
                yield _info(folder, tarfile.DIRTYPE, place.mode, place.owner), b""
        if name in files.entries:
            entry = files.entries[name]
            info = _info(name, tarfile.REGTYPE, mode(entry))
            info.size = len(entry) if isinstance(entry, bytes) else entry.stat().st_size
            yield info, entry


def _info(name: str, kind: bytes, mode: int, owner: int = 0) -> tarfile.TarInfo:
    info = tarfile.TarInfo(name)
    info.type, info.mode, info.uid, info.gid = kind, mode, owner, owner
    return info


class _Gzip:
    """A file for tarfile that compresses, and computes the digests on the way."""

    def __init__(self, out: IO[bytes]) -> None:
        self._out, self.raw = out, 0
        self._outer, self._inner = hashlib.sha256(), hashlib.sha256()
        self._deflate, self._crc = zlib.compressobj(_LEVEL, zlib.DEFLATED, -zlib.MAX_WBITS), 0
        self._put(_HEADER)

    def write(self, data: bytes) -> int:
        self.raw += len(data)
        self._inner.update(data)
        self._crc = zlib.crc32(data, self._crc)
        self._put(self._deflate.compress(data))
        return len(data)

    def finish(self) -> None:
        self._put(self._deflate.flush() + struct.pack("<II", self._crc, self.raw & 0xFFFFFFFF))

    def _put(self, data: bytes) -> None:
        self._outer.update(data)
        self._out.write(data)

    @property
    def digest(self) -> str:
        return f"sha256:{self._outer.hexdigest()}"

    @property
    def diff_id(self) -> str:
        return f"sha256:{self._inner.hexdigest()}"


def hash_of(entries: Mapping[str, Path | bytes]) -> str:
    """Return a digest in hexadecimal that depends only on the files' names, permissions and bytes."""
    digest = hashlib.sha256()
    for name, entry in sorted(entries.items()):
        inner = hashlib.sha256()
        with opened(entry) as body:
            while chunk := body.read(_CHUNK):
                inner.update(chunk)
        digest.update(f"{name}\0{mode(entry):o}\0{inner.hexdigest()}\n".encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def opened(entry: Path | bytes) -> IO[bytes]:
    """Open the file, or the bytes as a file."""
    return io.BytesIO(entry) if isinstance(entry, bytes) else entry.open("rb")


def mode(entry: Path | bytes) -> int:
    """Return a file's mode in the image: readable for all, because the trial's user does not own the files."""
    return 0o755 if isinstance(entry, Path) and entry.stat().st_mode & stat.S_IXUSR else 0o644
