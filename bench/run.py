"""Runs one measure on the product of a tree and prints its rows: `python -m bench.run MODULE.FUNCTION FOLDER TREE`.

FOLDER holds this package, and TREE the other packages. Processes that the measure starts import from both, too.
"""

from __future__ import annotations

import importlib
import json
import os
import sys


def main(name: str, folder: str, tree: str) -> None:
    """Run the measure; print its rows as JSON."""
    sys.path[:0] = [folder, tree]
    os.environ["PYTHONPATH"] = os.pathsep.join((folder, tree))
    module, _, function = name.partition(".")
    rows = list(getattr(importlib.import_module(f"bench.{module}"), function)())
    print(json.dumps(rows))


if __name__ == "__main__":
    main(*sys.argv[1:])
