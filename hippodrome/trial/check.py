"""`python -m hippodrome.trial.check FILE [SECONDS]` checks that the image holds what the agent needs.

FILE holds the keys of the section `trial` with which the agent is started, as JSON. The Dockerfile runs this. The agent
is loaded, starts its game, begins an episode, draws it and takes one step, as in a server, but in a process of its own,
which ends after SECONDS. In a game of several players, each policy is also asked for one action.

If this fails because a package, a module, a system library or a policy's file is missing, no participant could play:
the exit status is 1, and a line that begins with `LACKS` says what is missing. Any other failure is a warning with
status 0, since a build lacks what a server has: a participant, a group, the other keys of the section, more time and
memory.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hippodrome.protocol import environment
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.trial_check import check
from hippodrome.trial.agent import tracebacks
from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core.effects import AgentTimeout
from hippodrome.trial.server import process_group

if TYPE_CHECKING:
    from hippodrome.trial.agent.joint import JointAdapter

LACKS = "MISSING IN THE IMAGE: "
"""The beginning of the line that says what is missing."""
REMEDY = " => "
"""Separates, in the line that begins with LACKS, the missing thing from the advice."""
PACKAGE = "the package that brings "
"""Precedes the name of a missing module in the advice: the image does not know which package has the module."""

_SECONDS = 60.0
_GRACE = 5.0  # seconds in which a process whose time is over can write in which line the agent is
_LIMIT = 300  # characters of an error's message
_ENVIRONMENT = {
    environment.PROJECT_ID: "check",
    environment.USER_ID: "check",
    environment.SERVER: "check",
    environment.GROUP: "",
    environment.GAME_STEPS: "check",
}
_LIBRARY = re.compile(r"([^\s:]+): cannot open shared object file")
_MISSING = {"ImportError", "DependencyNotInstalled", "UnregisteredEnv"}  # the last two are classes of gymnasium.error


def main(file: Path, seconds: float) -> int:
    """Try the agent, and return the exit status."""
    with tempfile.TemporaryDirectory(prefix="check-", ignore_cleanup_errors=True) as folder:
        report = Path(folder) / "report"
        status = _run(file, report, seconds)
        try:
            result = json.loads(report.read_text())
        except (OSError, ValueError):
            result = {}
    if result.get("lacks"):
        print(f"{LACKS}{result['lacks']}", flush=True)
        return 1
    if status is None:
        result["failed"] = f"it has not come back within {seconds:g} s"
    if "failed" not in result and not result.get("well"):
        result["failed"] = f"it ended Python itself (status {status})"
    if "failed" in result:
        print(f"Warning: the agent could not be tried in the image, which is built all the same: {result['failed']}")
    else:
        print("The agent was tried in the image: it starts, draws and takes a step.")
    return 0


def _run(file: Path, report: Path, seconds: float) -> int | None:
    """Try the agent in a process, and return the process's exit status; None if it had to be killed."""
    return process_group.run(
        [sys.executable, "-m", "hippodrome.trial.check", "--agent", str(file), str(report), str(seconds)],
        seconds + _GRACE,
        env={**os.environ, **_ENVIRONMENT, environment.TRIAL: file.read_text()},
        stdout=subprocess.DEVNULL,  # a builder truncates a long log, and our line would be lost
        stderr=subprocess.DEVNULL,
    )


# In the agent's process


async def _try(file: Path, report: Path, seconds: float) -> None:
    """Let the agent play one step, and write the result to the file `report`."""
    folder, worker = Path(os.environ[environment.AGENT_DIR]).resolve(), Worker()
    try:
        await worker.call(lambda: _play(folder, json.loads(file.read_text())), limit=seconds)
        result: dict[str, Any] = {"well": True}
    except AgentTimeout as error:
        place = tracebacks.where(error, folder)
        result = {"failed": f"it has not come back within {seconds:g} s{f', and is in {place}' if place else ''}"}
    except Exception as error:  # noqa: BLE001 - the researcher's code may raise anything
        failure = f"{tracebacks.where(error, folder) or 'agent.py'}: {_words(error)}"
        remedy = _remedy(error)
        result = {"lacks": f"{failure}{REMEDY}{remedy}"} if remedy else {"failed": failure}
    part = report.with_suffix(".part")
    part.write_text(json.dumps(result))
    part.replace(report)


def _play(folder: Path, section: Mapping[str, Any]) -> None:
    from hippodrome.trial.agent.agent import AgentAdapter  # noqa: PLC0415 - the process that only reads the report needs no agent
    from hippodrome.trial.agent.joint import start  # noqa: PLC0415
    from hippodrome.trial.llm.endpoint import Endpoint  # noqa: PLC0415
    from hippodrome.trial.pictures import assets  # noqa: PLC0415
    from hippodrome.trial.pictures.reader import PictureReader  # noqa: PLC0415
    from hippodrome.trial.settings import DEFAULT_GAME  # noqa: PLC0415

    os.environ.update(Endpoint("").environment())  # a client may be made; while an image is built, no model is asked
    config, _ = check(dict(section))
    scene = config.scene
    reader = PictureReader(scene, assets.load(folder, scene.assets) if scene is not None else assets.Assets())
    # A single player takes action 0, which every game has.
    adapter = AgentAdapter(folder, config.game or DEFAULT_GAME, config.action_space or ("noop",), reader)
    started = start(adapter, config.named_players())
    started.set_game(config.options)
    if isinstance(started, AgentAdapter):
        started.reset(1)
        started.render()
        started.step(0)
        started.render()
    else:
        _play_jointly(started, config, folder)


def _play_jointly(adapter: JointAdapter, config: TrialSection, folder: Path) -> None:
    """Ask each policy that is to act for one action; then take one step with each player's first legal action."""
    from hippodrome.trial.core.players import who_plays  # noqa: PLC0415 - as above
    from hippodrome.trial.policies.places import load_policies  # noqa: PLC0415

    first, _ = adapter.reset(1)
    adapter.pictures()
    for group in config.groups() or (None,):
        players = who_plays(config, adapter.action_spaces, group)
        policies = load_policies(players, folder, adapter.agent_module, adapter.observation_spaces)
        for player, policy in policies.items():
            policy.reset(1)
            if player in first.to_act:
                policy.act(first.observations.get(player), first.infos.get(player, {}), first.masks.get(player))
            policy.close()
    adapter.step({})
    adapter.pictures()


def _remedy(error: BaseException) -> str:
    """Return the advice for an error whose cause is something missing in the image; empty for all other errors."""
    errors = list(_causes(error))
    for each in errors:
        library = _LIBRARY.search(str(each)) if isinstance(each, OSError | ImportError) else None
        if library:
            return (
                f"{library[1]} is a system library: name a package in requirements.txt that does without it "
                "(opencv-python-headless instead of opencv-python), or a base image that has it with --base"
            )
    for each in reversed(errors):
        if isinstance(each, ModuleNotFoundError) and each.name:
            return f"write {PACKAGE}{each.name.partition('.')[0]} into requirements.txt beside agent.py"
    if any(type(each).__name__ == "PolicyFileMissing" for each in errors):
        return "put the file there, and do not name it in .dockerignore"
    kinds = {kind.__name__ for each in errors for kind in type(each).__mro__} & _MISSING
    if "UnregisteredEnv" in kinds:
        return (
            "write the package with this game into requirements.txt, and its module before the game (module:Id-v0), or "
            "correct its name"
        )
    return "correct the packages and versions in requirements.txt beside agent.py" if kinds else ""


def _causes(error: BaseException) -> Iterator[BaseException]:
    """Yield the error, then the chain of errors that caused it (`raise … from …`)."""
    causes: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in causes:
        causes.append(cause)
        yield cause
        cause = cause.__cause__


def _words(error: BaseException) -> str:
    """Return the error's type and message on one line, of at most `_LIMIT` characters."""
    line = " ".join(f"{type(error).__name__}: {error}".split())
    printable = "".join(letter for letter in line if letter.isprintable())
    return printable if len(printable) <= _LIMIT else f"{printable[:_LIMIT]}…"


if __name__ == "__main__":
    if sys.argv[1] == "--agent":
        asyncio.run(_try(Path(sys.argv[2]), Path(sys.argv[3]), float(sys.argv[4])))
        os._exit(0)  # does not wait for threads that the agent has started
    sys.exit(main(Path(sys.argv[1]), float(sys.argv[2]) if len(sys.argv) > 2 else _SECONDS))
