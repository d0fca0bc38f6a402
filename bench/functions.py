"""Measures the functions as they are deployed: the sizes of their zips, and the processor time of a cold start.

The zips are built for this machine and unpacked. Fresh processes import from them without writing bytecode, as on
Lambda, where /var/task is read-only. boto3 has its bytecode, as in Lambda's runtime.
"""

from __future__ import annotations

import io
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from bench.table import Row, each, row
from deploy.code import build
from deploy.code.packages import Target

RUNS = 9  # fresh processes of each kind
WITHIN = 1.25  # our own imports may take a quarter of the time of the library and its client
CLIENTS = {  # the services that each function usually calls: docs/permissions.md
    "next_step": ["s3"],
    "start_server": ["s3", "scheduler", "ecs"],
    "task_changed": ["s3", "ec2", "route53", "sqs"],
    "stop_server": ["s3", "ecs", "route53", "scheduler"],
    "send_start_server_message": ["s3", "sns"],
    "send_stop_server_message": ["s3", "sns"],
    "sign_requests": ["s3"],
    "update_project_master_list": ["s3"],
    "sweep": ["s3", "ecs", "route53", "scheduler"],
    "renew_certificate": ["s3", "route53"],
}

OURS = """
import sys
sys.path.insert(0, sys.argv[1])
import importlib
importlib.import_module("lambdas." + sys.argv[2])
for service in sys.argv[3:]:
    from lambdas import installed
    installed.platform()._client(service)
"""
# The simplest code that makes the same clients: the library that our code uses, without boto3.
BARE = """
import botocore.session, sys
session = botocore.session.get_session()
for service in sys.argv[3:]:
    session.create_client(service, region_name="us-east-1")
"""


def rows() -> Iterator[Row]:
    """Measure the sizes and cold imports of all functions; about a minute."""
    yield from each([zips_and_imports])


def zips_and_imports() -> Iterator[Row]:
    """Measure the processor time of each function's import and clients, beside botocore with the same clients."""
    built = {function.name: function for function in build.functions(Target())}
    here = {function.name: function for function in build.functions(Target.here())}
    for name, services in CLIENTS.items():
        packed = len(built[name].pack())
        with tempfile.TemporaryDirectory() as folder:
            zipfile.ZipFile(io.BytesIO(here[name].pack())).extractall(folder)
            ours, bare = _alternating(folder, name, services)
        detail = {"zip for Lambda": f"{packed / 1e6:.2f} MB", "packages": ", ".join(built[name].distributions)}
        yield judged_import(name, ours, bare, detail)


def judged_import(name: str, ours: float, bare: float, detail: Mapping[str, str]) -> Row:
    """Return the row of one function. `ours` and `bare` are processor seconds, the function's and the library's."""
    return row(
        f"{name}: cold import and clients, against botocore with {', '.join(CLIENTS[name])}",
        1000 * ours,
        "ms CPU",
        yardstick=1000 * bare,
        at_most=WITHIN if name == "next_step" else None,  # every page waits for it; the others work behind the pages
        detail=detail,
    )


def _alternating(folder: str, name: str, services: Sequence[str]) -> tuple[float, float]:
    """Return the medians of processor seconds. The two take turns, so that load on the machine slows down both."""
    ours, bare = [], []
    for _ in range(RUNS):
        ours.append(_cpu(OURS, folder, name, services))
        bare.append(_cpu(BARE, folder, name, services))
    return statistics.median(ours), statistics.median(bare)


def _cpu(code: str, folder: str, name: str, services: Sequence[str]) -> float:
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {"PATH": os.environ["PATH"], "AWS_REGION": "us-east-1", "AWS_DEFAULT_REGION": "us-east-1"}
    subprocess.run(
        [sys.executable, "-I", "-B", "-c", code, folder, name, *services], check=True, env=environment, cwd=Path(folder)
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (after.ru_utime - before.ru_utime) + (after.ru_stime - before.ru_stime)
