"""A study that a test runs in a process of its own."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from hippodrome.local.rehearsal.study_process import Process, StudyProcess, logs_of
from hippodrome.protocol import environment
from hippodrome.trial.recordings.recording import read
from hippodrome.trial.settings import STALLED_SECONDS
from testing import processes


class HeldStudy(StudyProcess):
    """A `StudyProcess` for tests.

    With `port`, it can be started again at the same port. `stalled`: for how many seconds a page may leave a frame without
    acknowledgement; a page on a busy machine may need more than the 3 s that a server gives it otherwise.
    """

    def __init__(
        self, folder: Path, data: Path, *, port: int = 0, log: Path | None = None, stalled: float = STALLED_SECONDS
    ) -> None:
        super().__init__(folder, data, log=log)
        self._port, self._stalled = port, stalled

    def _begin(self, arguments: list[str], **options: Any) -> Process:
        options["env"] = {**options["env"], environment.STALLED_SECONDS: str(self._stalled)}
        arguments = [*arguments, "--port", str(self._port)]  # the last --port counts
        return processes.start("hippodrome", ["run", *arguments], cwd=processes.ROOT, **options)

    def steps_written(self, owner: str = "*") -> int:
        """Count the steps in the unfinished recordings of the servers of this participant or session; `*` means all."""
        files, steps = (logs_of(self.data).parent / "spool").glob(f"*/*/{owner}/trials/*/*.part"), 0
        for file in files:
            with contextlib.suppress(FileNotFoundError):  # the recording was finished meanwhile
                steps += sum(line["kind"] == "step" for line in read(file.read_bytes()))
        return steps
