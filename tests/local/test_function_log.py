"""The functions' log: the terminal shows what concerns the researcher, the file holds everything."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.console import Console

from hippodrome.control.log import failure
from hippodrome.control.ports import RetryLater
from hippodrome.local.activity.function_log import function_log
from hippodrome.local.activity.log import ActivityLog


@pytest.mark.parametrize(("error", "shown"), [(RetryLater("soon"), False), (KeyError("broken"), True)])
def test_a_redelivered_message_is_not_shown_in_the_terminal(tmp_path: Path, error: Exception, shown: bool) -> None:
    terminal = io.StringIO()
    with function_log(tmp_path, ActivityLog(Console(file=terminal, width=200))):
        failure("message failed", error)
    assert ("message failed" in terminal.getvalue()) is shown
    assert type(error).__name__ in (tmp_path / "functions.log").read_text()
