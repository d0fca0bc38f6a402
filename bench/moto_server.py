"""Runs moto as a server in a process of its own, for processes that use it as AWS."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

MOTO = """
import sys
from moto.server import ThreadedMotoServer
server = ThreadedMotoServer("127.0.0.1", 0, verbose=False)
server.start()
print(server.get_host_and_port()[1], flush=True)
sys.stdin.read()
"""


class MotoServer:
    """moto's server at a free port, with one bucket. Processes with the environment `env` use it as AWS."""

    def __init__(self, log: Path) -> None:
        self._log = log
        with log.open("wb") as errors:
            self._process = subprocess.Popen(
                [sys.executable, "-c", MOTO], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors
            )
        assert self._process.stdout is not None
        port = self._process.stdout.readline().strip().decode()
        if not port:
            raise RuntimeError(f"moto did not start: {log.read_text()}")
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("AWS_")}
        self.env = {
            **inherited,
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",  # moto accepts any key
            "AWS_REGION": "us-east-1",
            "AWS_DEFAULT_REGION": "us-east-1",
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
            "BUCKET": "hippodrome",
            "ROOT_DOMAIN": "example.org",
        }
        self.s3 = self._client()
        self.s3.create_bucket(Bucket="hippodrome")

    def _client(self) -> Any:
        import botocore.session

        env = self.env
        return botocore.session.get_session().create_client(
            "s3",
            region_name=env["AWS_REGION"],
            endpoint_url=env["AWS_ENDPOINT_URL"],
            aws_access_key_id=env["AWS_ACCESS_KEY_ID"],
            aws_secret_access_key=env["AWS_SECRET_ACCESS_KEY"],
        )

    def put(self, key: str, body: bytes) -> None:
        """Store a document in the bucket."""
        self.s3.put_object(Bucket="hippodrome", Key=key, Body=body)

    def requests(self) -> list[str]:
        """Return every request so far, such as `PUT /hippodrome/some/key`."""
        return re.findall(r'"([A-Z]+ /\S*) HTTP/', self._log.read_text())

    def close(self) -> None:
        """End the server's process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


@contextlib.contextmanager
def moto_server() -> Iterator[MotoServer]:
    """Run moto's server within the block."""
    with tempfile.TemporaryDirectory() as folder:
        server = MotoServer(Path(folder, "moto.log"))
        try:
            yield server
        finally:
            server.close()
