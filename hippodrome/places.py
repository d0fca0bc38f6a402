"""Where the files lie that are not modules: the only place that knows whether Hippodrome is a clone or a wheel.

A wheel holds these files in `hippodrome/bundled/` (pyproject.toml); a clone has them beside the package.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib import metadata, resources
from pathlib import Path
from urllib.parse import urlsplit
from urllib.request import url2pathname

_PACKAGE = Path(str(resources.files("hippodrome"))).resolve()
_BUNDLED = _PACKAGE / "bundled"
PACKAGES = _PACKAGE.parent
"""The folder that has the package `hippodrome`."""
IS_CLONE = not _BUNDLED.is_dir()
ROOT = PACKAGES if IS_CLONE else _BUNDLED
"""The folder of `docs/`, `lambdas/`, `infra/`, `requirements/`, `examples/` and of the first example's files."""


def for_child(environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables with which another process of this Python can import `hippodrome`.

    Only a clone that is not installed needs one, PYTHONPATH. The folder of installed packages is never in it: there it
    would come before Python's own modules.
    """
    if not IS_CLONE or _is_installed():
        return dict(environment)
    return {
        **environment,
        "PYTHONPATH": os.pathsep.join([str(PACKAGES), *filter(None, [environment.get("PYTHONPATH")])]),
    }


def _is_installed() -> bool:
    """Whether this clone, and no other, is installed here with `pip install --editable`."""
    try:
        origin = metadata.distribution("hippodrome").read_text("direct_url.json")
    except metadata.PackageNotFoundError:
        return False
    folder = url2pathname(urlsplit(json.loads(origin)["url"]).path) if origin else ""
    return bool(folder) and Path(folder).resolve() == PACKAGES
