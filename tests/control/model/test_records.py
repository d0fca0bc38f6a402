"""Reading records: by several threads at once, and only in `records.py`."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[3]
FIRST_READ_BY_TWO = """
from __future__ import annotations
import threading, time
from hippodrome.control.model.records import Record, from_data, from_json

begun = threading.Event()

def number():  # the type of a field, which msgspec asks for when the first record is read
    begun.set()
    time.sleep(0.3)
    return int

class Inner(Record):
    value: number()

class Outer(Record):
    name: str
    inner: Inner

def read_another_way():
    begun.wait()
    found.append(READ)

found = []
thread = threading.Thread(target=read_another_way)
thread.start()
found.append(from_json(b'{"name": "a", "inner": {"value": 1}}', Outer))
thread.join()
print([one.inner.value for one in found])
"""
"""While the first thread has msgspec look at the types, the second reads."""
JSON = """from_json(b'{"name": "b", "inner": {"value": 1}}', Outer)"""
DATA = """from_data({"name": "b", "inner": {"value": 1}}, Outer)"""


@pytest.mark.parametrize("second", [JSON, DATA], ids=["json", "data"])
def test_two_threads_read_the_first_record_of_a_kind_at_once(second: str) -> None:
    program = FIRST_READ_BY_TWO.replace("READ", second)
    command = [sys.executable, "-c", program]
    ran = subprocess.run(command, check=False, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (ran.returncode, ran.stdout) == (0, "[1, 1]\n"), ran.stderr


@pytest.mark.parametrize("package", ["hippodrome", "lambdas", "protocol", "trial", "bots", "local", "deploy", "export"])
def test_only_the_module_records_decodes_into_types(package: str) -> None:
    """`msgspec.json.decode` without a type is allowed: it does what `json.loads` does."""
    into_types = re.compile(r"\bmsgspec\.(convert\b|\w+\.Decoder\b|\w+\.decode\b.*\btype=)")
    reading = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / package).rglob("*.py")
        if into_types.search(path.read_text())
    }
    assert reading == ({"hippodrome/control/model/records.py"} if package == "hippodrome" else set())
