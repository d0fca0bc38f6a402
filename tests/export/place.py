"""A folder that `data` fills from the data of one machine, for tests."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from tests.deployment.installation import CommandResult
from tests.export.data_world import into_folder


class Place:
    """A data folder as `make run` leaves it, and the folder that `data` fills from it."""

    def __init__(self, tmp: Path, capsys: Any) -> None:
        self.tmp, self._capsys = tmp, capsys
        self.data, self.out = tmp / "data", tmp / "out"
        self.put = into_folder(self.data)

    def run(self, *more: str, out: Path | None = None, study: str = "maze") -> CommandResult:
        self._capsys.readouterr()
        code = main(["data", study, "--to", str(out or self.out), "--from", str(self.data), *more])
        printed = self._capsys.readouterr()
        assert "This should not have happened" not in printed.err, printed.err
        return CommandResult(code, printed.out, printed.err)

    def rows(self, name: str = "answers") -> list[dict[str, str]]:
        return rows(self.out / f"{name}.csv")

    def listed(self) -> dict[str, str]:
        """Return, by name, the hashes of the manifest's files."""
        return {line["path"]: line["sha256"] for line in json.loads((self.out / "manifest.json").read_text())["files"]}

    def done(self, *more: str) -> dict[str, Any]:
        """Run the command, which must succeed, and return the summary that it prints."""
        ran = self.run("--json", *more)
        assert ran.code == Exit.DONE, ran.err
        assert self.run("--check").code == Exit.DONE
        found: dict[str, Any] = ran.json
        return found


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.DictReader(file))
