"""Where the files lie that are no Python: the only place that knows how Hippodrome was installed."""

from __future__ import annotations

from pathlib import Path

PACKAGES = Path(__file__).resolve().parent.parent
"""The folder that has the package `hippodrome`: it makes `import hippodrome` work in another process."""
ROOT = PACKAGES
"""The folder of `lambdas/`, `infra/`, `requirements/`, `examples/` and of the first example's files."""
