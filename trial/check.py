"""`python -m trial.check FILE [SECONDS]`: whether the image holds what the agent needs; a step of its Dockerfile.

FILE holds what of the section `trial` the agent is started with, as JSON. The agent is loaded, starts its game, begins
an episode, draws it and takes one step, as in a server, but in a process of its own that is ended after SECONDS.

Where several play, each policy is asked for one action too.

Exit status 1 and a line that begins with `LACKS` if that fails because a package, a module, a system library or the
file of a policy is not there: it will not be there for any participant. All else is a warning and status 0, since a
server may have what a build has not: a participant, a group, the rest of the section, more time and memory.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol import environment
from protocol.trial import TrialSection
from protocol.trial_check import check
from trial.agent import tracebacks
from trial.server import process_group

if TYPE_CHECKING:
    from trial.agent.joint import JointAdapter

LACKS = "MISSING IN THE IMAGE: "
"""Begins the line that says what is missing."""
REMEDY = " => "
"""Stands in that line between what is missing and what to do about it."""
PACKAGE = "the package that brings "
"""Stands in what to do before the name of a module whose package is not known here."""

_SECONDS = 60.0
_LIMIT = 300  # characters of an error's own words
_ENVIRONMENT = {
    environment.PROJECT_ID: "check",
    environment.USER_ID: "check",
    environment.SERVER: "check",
    environment.GROUP: "",
    environment.GAME_STEPS: "check",
}
_LIBRARY = re.compile(r"([^\s:]+): cannot open shared object file")
_MISSING = {"ImportError", "DependencyNotInstalled", "UnregisteredEnv"}  # the last two of gymnasium.error


def main(file: Path, seconds: float) -> int:
    """Try the agent; the exit status."""
    with tempfile.TemporaryDirectory(prefix="check-", ignore_cleanup_errors=True) as place:
        report = Path(place) / "report"
        status = _run(file, report, seconds)
        try:
            found = json.loads(report.read_text())
        except (OSError, ValueError):
            found = {}
    if found.get("lacks"):
        print(f"{LACKS}{found['lacks']}", flush=True)
        return 1
    if status is None:
        found["failed"] = f"it has not come back within {seconds:g} s"
    if "failed" not in found and not found.get("well"):
        found["failed"] = f"it ended Python itself (status {status})"
    if "failed" in found:
        print(f"Warning: the agent could not be tried in the image, which is built all the same: {found['failed']}")
    else:
        print("The agent was tried in the image: it starts, draws and takes a step.")
    return 0


def _run(file: Path, report: Path, seconds: float) -> int | None:
    """The exit status of the agent's process, None if it had to be killed."""
    return process_group.run(
        [sys.executable, "-m", "trial.check", "--agent", str(file), str(report)],
        seconds,
        env={**os.environ, **_ENVIRONMENT, environment.TRIAL: file.read_text()},
        stdout=subprocess.DEVNULL,  # a builder cuts off what says too much, and our line would be lost
        stderr=subprocess.DEVNULL,
    )


# In the agent's process


def _try(file: Path, report: Path) -> None:
    """Let the agent play a step, and write down what came of it."""
    folder = Path(os.environ[environment.AGENT_DIR]).resolve()
    try:
        _play(folder, json.loads(file.read_text()))
        found: dict[str, Any] = {"well": True}
    except BaseException as error:  # noqa: BLE001 - SystemExit in a researcher's code is a failure like another
        said = f"{tracebacks.where(error, folder) or 'agent.py'}: {_words(error)}"
        remedy = _remedy(error)
        found = {"lacks": f"{said}{REMEDY}{remedy}"} if remedy else {"failed": said}
    part = report.with_suffix(".part")
    part.write_text(json.dumps(found))
    part.replace(report)


def _play(folder: Path, section: Mapping[str, Any]) -> None:
    from trial.agent.agent import AgentAdapter  # noqa: PLC0415 - a process that only reads the report needs none of it
    from trial.agent.starting import start  # noqa: PLC0415
    from trial.pictures import assets  # noqa: PLC0415
    from trial.pictures.reader import PictureReader  # noqa: PLC0415
    from trial.settings import DEFAULT_GAME  # noqa: PLC0415

    config, _ = check(dict(section))
    scene = config.scene
    reader = PictureReader(scene, assets.load(folder, scene.assets) if scene is not None else assets.Assets())
    # One player takes the first action alone, which every game has.
    adapter = AgentAdapter(folder, config.game or DEFAULT_GAME, config.action_space or ("noop",), reader)
    player = start(adapter, config.named_players())
    if isinstance(player, AgentAdapter):
        player.reset(1)
        player.render()
        player.step(0)
        player.render()
    else:
        _play_jointly(player, config, folder)


def _play_jointly(adapter: JointAdapter, config: TrialSection, folder: Path) -> None:
    """One step, in which all who are to act take their first action and each policy is asked for one."""
    from trial.core.players import who_plays  # noqa: PLC0415 - as above
    from trial.policies.places import load_policies  # noqa: PLC0415

    now, _ = adapter.reset(1)
    adapter.pictures()
    for group in config.groups() or (None,):
        players = who_plays(config, adapter.action_spaces, group)
        policies = load_policies(players, folder, adapter.agent_module, adapter.observation_spaces)
        for player, policy in policies.items():
            policy.reset(1)
            if player in now.to_act:
                policy.act(now.observations.get(player), now.infos.get(player, {}), now.masks.get(player))
            policy.close()
    adapter.step({})
    adapter.pictures()


def _remedy(error: BaseException) -> str:
    """What to do about an error that tells of something that is not in the image; empty for all others."""
    errors = list(_causes(error))
    for one in errors:
        library = _LIBRARY.search(str(one)) if isinstance(one, OSError | ImportError) else None
        if library:
            return (
                f"{library[1]} is a system library: name a package in requirements.txt that does without it "
                "(opencv-python-headless instead of opencv-python), or a base image that has it with --base"
            )
    for one in reversed(errors):
        if isinstance(one, ModuleNotFoundError) and one.name:
            return f"write {PACKAGE}{one.name.partition('.')[0]} into requirements.txt beside agent.py"
    if any(type(one).__name__ == "PolicyFileMissing" for one in errors):
        return "put the file there, and do not name it in .dockerignore"
    kinds = {kind.__name__ for one in errors for kind in type(one).__mro__} & _MISSING
    if "UnregisteredEnv" in kinds:
        return "write the package with this game into requirements.txt and import it in agent.py, or correct its name"
    return "correct the packages and versions in requirements.txt beside agent.py" if kinds else ""


def _causes(error: BaseException) -> Iterator[BaseException]:
    """The error, and those from which it was raised (`raise … from …`)."""
    seen: list[BaseException] = []
    one: BaseException | None = error
    while one is not None and one not in seen:
        seen.append(one)
        yield one
        one = one.__cause__


def _words(error: BaseException) -> str:
    """The error in its own words, on one line."""
    said = " ".join(f"{type(error).__name__}: {error}".split())
    plain = "".join(letter for letter in said if letter.isprintable())
    return plain if len(plain) <= _LIMIT else f"{plain[:_LIMIT]}…"


def _agent(file: Path, report: Path) -> None:
    thread = threading.Thread(target=_try, args=[file, report], daemon=True)  # as in a server, not the main thread
    thread.start()
    thread.join()
    os._exit(0)  # whatever threads the agent has left


if __name__ == "__main__":
    if sys.argv[1] == "--agent":
        _agent(Path(sys.argv[2]), Path(sys.argv[3]))
    sys.exit(main(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else _SECONDS))
