"""Workers that are forked from a process that has imported the tests."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from testing.waiting import until
from tests import forked_workers

pytestmark = pytest.mark.skipif(
    not forked_workers.POSSIBLE, reason="this system has no pidfd_open, without which nothing is forked"
)
SETTINGS = "[pytest]\naddopts = --import-mode=importlib -p no:cacheprovider\n"
IMPORTED = "from pathlib import Path\nwith open(Path(__file__).with_name('imported'), 'a') as file:\n    file.write('once\\n')\n"
HANGS = """
import time
from pathlib import Path

def test_it_hangs():
    Path(__file__).with_name("begun").touch()
    time.sleep(100)
"""


def command(folder: Path, workers: int = 2) -> list[str]:
    """Run the tests of this folder with forked workers."""
    (folder / "pytest.ini").write_text(SETTINGS)
    options = ("-p", "xdist", "-p", "tests.forked_workers", "-n", str(workers), "--rootdir", str(folder))
    return [sys.executable, "-m", "pytest", *options, str(folder)]


def environment() -> dict[str, str]:
    others = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    return {**others, "PYTHONPATH": str(forked_workers.ROOT), "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}


def run(folder: Path, workers: int = 2) -> tuple[int, str]:
    """Return the exit code, and what is printed."""
    ran = subprocess.run(
        command(folder, workers),
        check=False,
        cwd=folder,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=120,
    )
    return ran.returncode, ran.stdout + ran.stderr


def test_tests_are_imported_once_for_all_workers(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(IMPORTED + "".join(f"def test_{number}(): pass\n" for number in range(9)))
    code, printed = run(tmp_path, workers=3)
    assert (code, re.findall(r"(\d+) passed", printed)) == (0, ["9"]), printed
    assert (tmp_path / "imported").read_text() == "once\n"


def test_a_worker_that_dies_is_replaced_and_the_other_tests_run(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "import os\ndef test_dies(): os._exit(3)\n" + "".join(f"def test_{number}(): pass\n" for number in range(9))
    )
    code, printed = run(tmp_path, workers=1)
    assert (code, re.findall(r"(\d+) (failed|passed)", printed)) == (1, [("1", "failed"), ("9", "passed")]), printed
    assert "worker 'gw0' crashed while running 'test_it.py::test_dies'" in printed


def test_a_file_that_cannot_be_imported_is_reported(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text("import nothing_of_this_name\n")
    code, printed = run(tmp_path)
    assert code == 1, printed
    assert "Each worker imports the tests itself: the tests cannot be collected" in printed
    assert "ModuleNotFoundError: No module named 'nothing_of_this_name'" in printed


def test_tests_whose_import_starts_a_thread_run_in_workers_that_import_them(tmp_path: Path) -> None:
    starts = "import threading\nthread = threading.Thread(target=threading.Event().wait, name='idle', daemon=True)\nthread.start()\n"
    (tmp_path / "test_it.py").write_text(IMPORTED + starts + "def test_it():\n    assert thread.is_alive()\n")
    code, printed = run(tmp_path)
    assert code == 0, printed
    assert "Each worker imports the tests itself: importing the tests starts threads: idle" in printed
    assert (tmp_path / "imported").read_text() == "once\n" * 3


def test_what_a_module_prints_with_the_streams_of_its_import_is_captured(tmp_path: Path) -> None:
    (tmp_path / "test_it.py").write_text(
        "import sys\nkept = sys.stdout\n"
        "def test_it(capfd):\n    print('a line', file=kept)\n    assert capfd.readouterr().out == 'a line\\n'\n"
    )
    code, printed = run(tmp_path)
    assert code == 0, printed


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_nothing_is_left_when_the_tests_are_ended(tmp_path: Path, number: signal.Signals) -> None:
    (tmp_path / "test_it.py").write_text(HANGS)
    with open(tmp_path / "printed", "wb") as printed:
        tests = subprocess.Popen(
            command(tmp_path), cwd=tmp_path, env=environment(), stdout=printed, stderr=printed, start_new_session=True
        )
    try:
        until((tmp_path / "begun").exists, 60)
        processes = psutil.Process(tests.pid).children(recursive=True)
        assert len(processes) == 5, "the process that forks, and two workers with a client each"
        if number == signal.SIGINT:  # a terminal sends it to all
            os.killpg(tests.pid, number)
        else:
            tests.send_signal(number)
        tests.wait(60)
        until(lambda: not any(each.is_running() and each.status() != psutil.STATUS_ZOMBIE for each in processes), 60)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(tests.pid, signal.SIGKILL)
