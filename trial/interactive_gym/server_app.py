"""`server_app.run(config)`: makes a project from an experiment, and runs it on this machine."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from trial.interactive_gym import on_server
from trial.interactive_gym.playing import Unplayable
from trial.interactive_gym.project import make
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.scenes import game_of

_HIPPODROME = Path(__file__).resolve().parents[2]
_END_SECONDS = 60


def run(config: Any, *, project: str | os.PathLike[str] | None = None, serve: bool = True) -> Path | None:
    """Make the experiment's project, print its folder, and run it until Ctrl-C. Return the folder.

    `project` is the folder, by default one beside the experiment's file. Without `serve`, the project is made, but not
    run. On a participant's server, where the experiment's file is loaded again, this does nothing and returns None.
    Raises SystemExit with a sentence if the experiment cannot be played here, or if the run fails.
    """
    if on_server.is_loading():
        return None
    try:
        game = game_of(config)
        if not isinstance(game, RemoteConfig):
            raise Unplayable(f"run() takes a RemoteConfig, not {type(config).__name__}")
        candidates = (config, getattr(config, "stager", None), game)
        made_project = make(game, None if project is None else Path(project), candidates)
    except Unplayable as error:
        sys.exit(f"This experiment cannot be played here: {error}")
    for remark in made_project.remarks:
        print(f"Remark: {remark}")
    folder = shlex.quote(str(made_project.folder))
    print(f"The project is in {made_project.folder}.")
    check = f"make -C {shlex.quote(str(_HIPPODROME))} check PROJECT={folder}"
    print(f"Check it with `{check}`; deploy it as docs/aws-project.md says.", flush=True)
    if serve:
        _run_locally(made_project.folder, game.port)
    return made_project.folder


def _run_locally(folder: Path, port: int) -> None:
    """Run the project on this machine by `python -m local`, which prints the participants' link, until Ctrl-C."""
    if importlib.util.find_spec("local") is None and not (_HIPPODROME / "local").is_dir():
        sys.exit("The project cannot be held here: there is no Hippodrome beside this package.")
    command = [sys.executable, "-m", "local", str(folder), "--port", str(port), "--data", str(folder / "data")]
    paths = [str(_HIPPODROME), *filter(None, [os.environ.get("PYTHONPATH")])]
    process = subprocess.Popen(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})  # noqa: S603 - ours
    previous = signal.signal(signal.SIGTERM, _interrupt)
    try:
        status = process.wait()
    except KeyboardInterrupt:
        status = _end(process)
    finally:
        signal.signal(signal.SIGTERM, previous)
    if status:
        sys.exit(status)


def _interrupt(*_: Any) -> None:
    raise KeyboardInterrupt


def _end(process: subprocess.Popen[bytes]) -> int:
    """End the local run by signals, and wait while it stores the last data. Each further Ctrl-C sends the next signal.

    Return 0, or 1 if the run has not ended even after SIGKILL.
    """
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if process.poll() is None:
            process.send_signal(number)
        with contextlib.suppress(KeyboardInterrupt, subprocess.TimeoutExpired):
            process.wait(_END_SECONDS)
            return 0
    return 1
