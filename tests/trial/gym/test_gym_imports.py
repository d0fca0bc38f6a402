"""Modules that the listening process and a client must not import."""

from __future__ import annotations

import subprocess
import sys

from testing.gym_server import ROOT

SHOW = "; import sys; print(*sorted(sys.modules))"


def imported(program: str) -> set[str]:
    """Return the modules that a new Python has after this program."""
    command = [sys.executable, "-c", program + SHOW]
    return set(subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split())


def test_the_process_that_listens_imports_neither_numpy_nor_gymnasium() -> None:
    """Its memory is that of idle connections."""
    found = imported("import trial.gym.__main__, trial.gym.server")
    assert "trial.gym.server" in found
    assert not found & {"numpy", "gymnasium", "PIL"}


def test_a_client_imports_only_the_trials_modules_for_environments_and_values() -> None:
    found = imported("from trial.gym import RemoteEnv")
    ours = {name for name in found if name.split(".")[0] in {"trial", "protocol", "hippodrome", "lambdas", "local"}}
    values = {"trial.recordings", "trial.recordings.recorded_values"}
    assert ours - {"trial"} - values == {name for name in ours if name.startswith("trial.gym")}
    assert not ours & {"trial.gym.server", "trial.gym.worker", "trial.gym.session"}
    assert not found & {"boto3", "PIL", "ale_py", "isal"}
