"""docs/tutorial.md, followed as it is written: its files, its commands, what they print, and the figure at the end."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests import first_hour

PAGE = (first_hour.ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
NAME = re.compile(r"(?:#|<!--) (\S+)(?: -->)?\n")
"""The first line of a block says which file it is."""


def blocks() -> Iterator[tuple[str, str]]:
    """Yield each block with its language, in the order of the page."""
    yield from re.findall(r"(?ms)^```(\w+)\n(.*?)^```", PAGE)


class Reader:
    """Somebody who follows the page in a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        self._env = {
            **os.environ,
            "PATH": path,
            "PYTHONPATH": str(first_hour.ROOT),
            "MPLBACKEND": "agg",
            "COLUMNS": "150",
        }

    def write(self, text: str) -> None:
        """Write a block to the file that its first line names."""
        found = NAME.match(text)
        assert found, text
        (self.folder / found[1]).write_text(text, encoding="utf-8")

    def change(self, text: str) -> None:
        """Replace the line after `-` by that after `+`, in the file that the block's first line names."""
        found = NAME.match(text)
        assert found, text
        file = self.folder / found[1]
        old, new = (re.findall(rf"(?m)^\{sign}(.*)", text) for sign in "-+")
        page = file.read_text(encoding="utf-8")
        assert page.count(old[0]) == 1, f"{file} has not once: {old[0]}"
        file.write_text(page.replace(old[0], new[0]), encoding="utf-8")

    def type(self, command: str) -> str:
        """Run a command; return what it prints."""
        done = subprocess.run(
            ["bash", "-c", command],
            check=False,
            cwd=self.folder,
            env=self._env,
            capture_output=True,
            text=True,
            timeout=150,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"
        return done.stderr + done.stdout

    def visit(self, command: str) -> str:
        """Run a command that goes on until Ctrl-C; open the link that it prints."""
        pipe = subprocess.PIPE
        line = f"exec {command} --port 0"  # another study may run on this machine
        ran = subprocess.Popen(
            ["bash", "-c", line], cwd=self.folder, env=self._env, stdout=pipe, stderr=subprocess.STDOUT, text=True
        )
        assert ran.stdout
        printed = ""
        for text in ran.stdout:
            printed += text
            if link := re.search(r"http://127\S+/next\?projectId=\S+", text):
                with urllib.request.urlopen(link[0]) as page:
                    assert "Acorns for two" in page.read().decode()
                break
        ran.send_signal(signal.SIGINT)
        printed += ran.stdout.read()
        assert ran.wait() in (0, 130), printed
        return printed.replace(":" + link[0].split(":")[2].split("/")[0], ":8000") if link else printed


@pytest.mark.timeout(400)
def test_the_tutorial_leads_to_a_figure(tmp_path: Path) -> None:
    reader = Reader(tmp_path)
    for language, text in blocks():
        if language != "console":
            (reader.change if language == "diff" else reader.write)(text)
            continue
        for part in re.split(r"(?m)^\$ ", text)[1:]:
            command, *shown = part.splitlines()
            printed = (reader.visit if command.startswith("hippodrome run") else reader.type)(command)
            assert first_hour.differs([line for line in shown if line.strip()], printed) == "", printed
    assert (tmp_path / "figure.png").read_bytes().startswith(b"\x89PNG")
