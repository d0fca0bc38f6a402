"""`python -m hippodrome.trial.interactive_gym experiment.py`: makes a project of an experiment, and runs it here."""

from __future__ import annotations

import argparse
import os
import shlex
import sys
from pathlib import Path

from hippodrome.trial.interactive_gym.options import Unplayable
from hippodrome.trial.interactive_gym.project import make, study_id


def main() -> None:
    """Make the project of the script that the command line names, print its folder, and run it until Ctrl-C."""
    parser = argparse.ArgumentParser(prog="python -m hippodrome.trial.interactive_gym")
    parser.add_argument("script", help="the experiment's file, or the name of its module, below the present folder")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="the script's own arguments")
    parser.add_argument("--project", type=Path, help="the project's folder, by default one beside the script")
    parser.add_argument("--no-run", action="store_true", help="make the project, and do not run it")
    options = parser.parse_args()
    is_file = options.script.endswith(".py")
    path = Path(os.path.relpath(options.script if is_file else f"{options.script.replace('.', '/')}.py"))
    folder = (options.project or path.parent / f"{study_id(path.stem)}-study").resolve()
    try:
        if path.parts[0] == "..":
            raise Unplayable(f"{path} is not below the present folder: start in its folder, or in one above it")
        config, remarks = make(path, options.arguments, folder)
    except Unplayable as error:
        sys.exit(f"This experiment cannot be played here: {error}")
    for remark in remarks:
        print(f"Remark: {remark}")
    check = shlex.join([sys.executable, "-m", "hippodrome", "check", str(folder)])
    print(f"The project is in {folder}.")
    print(f"Check it with `{check}`; deploy it as docs/aws-project.md says.", flush=True)
    if not options.no_run:
        run = [sys.executable, "-m", "hippodrome", "run", str(folder), "--port", str(config.port)]
        os.execv(sys.executable, [*run, "--data", f"{folder}/data"])  # noqa: S606 - ours


if __name__ == "__main__":
    main()
