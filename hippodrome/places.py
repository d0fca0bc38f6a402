"""Where the files lie that are not modules: the only place that knows whether Hippodrome is a clone or a wheel.

A wheel holds these files in `hippodrome/bundled/` (pyproject.toml); a clone has them beside the package.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

_PACKAGE = Path(str(resources.files("hippodrome")))
PACKAGES = _PACKAGE.resolve().parent
"""The folder that has the package `hippodrome`."""
_BUNDLED = PACKAGES / "hippodrome" / "bundled"
IS_CLONE = not _BUNDLED.is_dir()
ROOT = PACKAGES if IS_CLONE else _BUNDLED
"""The folder of `lambdas/`, `infra/`, `requirements/`, `examples/` and of the first example's files."""
