"""Layers of an image: the same files make the same bytes, on every machine."""

from __future__ import annotations

import gzip
import io
import os
import tarfile
from pathlib import Path

import pytest

from hippodrome.deployment.study.image.layers import Files, Folder, layer
from hippodrome.deployment.study.image.registry import digest_of


def files(folder: Path) -> Files:
    folder.mkdir(parents=True)
    (folder / "run.sh").write_text("echo")
    (folder / "run.sh").chmod(0o700)
    (folder / "größe.py").write_text("x = 1\n")
    (folder / "größe.py").chmod(0o600)
    names = {f"project/{path.name}": path for path in folder.iterdir()}
    return Files({**names, "a/b/c": b"bytes"}, {"scratch": Folder(0o700, 10001)})


def test_a_layer_depends_on_names_bytes_and_permissions_alone(tmp_path: Path) -> None:
    there = files(tmp_path / "there")
    os.utime(tmp_path / "there/run.sh", (1, 1))
    before = os.umask(0o077)
    try:
        here = files(tmp_path / "here")
    finally:
        os.umask(before)
    first, second = layer("x", "1", tmp_path / "c1", lambda: there), layer("x", "1", tmp_path / "c2", lambda: here)
    assert (first.digest, first.diff_id, first.size) == (second.digest, second.diff_id, second.size)
    assert there.hash == here.hash
    # Python 3.11, 3.12, 3.13 and 3.14 make this one, whatever their own gzip writes into its header.
    assert first.diff_id == "sha256:6ff4bad2ea1e05d2e3c018e0e36738909aa745ae4ddf448e11c0bc2d365542b3"


def test_a_layer_is_what_its_digests_say(tmp_path: Path) -> None:
    made = layer("x", "1", tmp_path / "cache", lambda: files(tmp_path / "study"))
    body = made.file.read_bytes()
    assert made.digest == digest_of(body)
    assert made.size == len(body)
    raw = gzip.decompress(body)
    assert made.diff_id == digest_of(raw)
    assert made.raw == len(raw)
    with tarfile.open(fileobj=io.BytesIO(raw)) as tar:
        members = {info.name: info for info in tar}
    assert list(members) == ["a", "a/b", "a/b/c", "project", "project/größe.py", "project/run.sh", "scratch"]
    modes = {name: (info.mode, info.uid) for name, info in members.items()}
    assert modes["project/run.sh"] == (0o755, 0)
    assert modes["project/größe.py"] == (0o644, 0), "readable for the trial's user, whatever the umask was"
    assert modes["scratch"] == (0o700, 10001)
    assert modes["project"] == (0o755, 0)
    assert {info.mtime for info in members.values()} == {0}


def test_a_layer_is_made_once(tmp_path: Path) -> None:
    made = layer("x", "1", tmp_path / "cache", lambda: files(tmp_path / "study"))

    def never() -> Files:
        raise AssertionError

    assert layer("x", "1", tmp_path / "cache", never) == made
    with pytest.raises(AssertionError):
        layer("x", "2", tmp_path / "cache", never)
    assert {path.name for path in (tmp_path / "cache").iterdir()} == {"1.json", "1.tar.gz"}, "nothing half made is left"
