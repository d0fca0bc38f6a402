"""The stores' contract, on a folder and on (moto's) S3."""

import gzip
from concurrent.futures import ThreadPoolExecutor

import boto3
import pytest
from moto import mock_aws

from trial.recordings.store import open_store


@pytest.fixture(params=["folder", "s3", "s3 with a prefix"])
def store(request, tmp_path, monkeypatch):
    if request.param == "folder":
        yield open_store(str(tmp_path / "store"))
        return
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.setenv(name, "test")
    monkeypatch.setenv("AWS_DEFAULT_REGION", "us-east-1")
    monkeypatch.delenv("AWS_ENDPOINT_URL", raising=False)
    with mock_aws():
        boto3.client("s3").create_bucket(Bucket="data")
        yield open_store("s3://data" if request.param == "s3" else "s3://data/some/where/")


def test_what_is_created_can_be_read(store, tmp_path):
    assert store.get("a/b/c.json") is None
    assert store.create("a/b/c.json", b"one") is True
    assert store.get("a/b/c.json") == b"one"
    path = tmp_path / "recording"
    path.write_bytes(gzip.compress(b"lines"))
    assert store.create("a/b/d.gz", path) is True
    assert gzip.decompress(store.get("a/b/d.gz")) == b"lines"


def test_nothing_is_overwritten(store):
    assert store.create("a/x.json", b"first") is True
    assert store.create("a/x.json", b"second") is False
    assert store.get("a/x.json") == b"first"


def test_of_many_writers_one_wins(tmp_path):
    store = open_store(str(tmp_path))
    with ThreadPoolExecutor(8) as pool:
        won = list(pool.map(lambda n: store.create("k/x.json", str(n).encode()), range(50)))
    assert won.count(True) == 1
    assert store.get("k/x.json") == str(won.index(True)).encode()
    assert [path.name for path in (tmp_path / "k").iterdir()] == ["x.json"]
