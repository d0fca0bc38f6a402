"""The modules that every trial server imports, and the researcher's files that would hide them.

Python looks for a module beside agent.py before it looks among the installed packages.
"""

from __future__ import annotations

import os
from pathlib import Path

SERVER_MODULES = (
    "PIL",
    "ale_py",
    "cloudpickle",
    "farama_notifications",
    "gymnasium",
    "isal",
    "numpy",
    "onnxruntime",
    "typing_extensions",
    "websockets",
    "yaml",
)
"""The modules of the packages in `requirements/trial.txt` and of their dependencies, and of policies' files."""


def hiding(folder: Path) -> list[str]:
    """Return a sentence for each file or package in the folder of agent.py that hides a module which servers need.

    Raises OSError if the folder cannot be read.
    """
    present = set(os.listdir(folder))
    files = [(f"{module}.py", module) for module in SERVER_MODULES]
    packages = [(f"{module}/", module) for module in SERVER_MODULES if (folder / module / "__init__.py").is_file()]
    return [
        f"{file} hides the package {module}, which servers need; rename it"
        for file, module in sorted([*files, *packages])
        if file.rstrip("/") in present
    ]
