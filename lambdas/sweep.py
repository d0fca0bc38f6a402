"""Timer: remove what no live record owns."""

from dataclasses import asdict
from typing import Any

from hippodrome.sweep import Sweep
from lambdas import installed


def handler(event: dict[str, Any], context: object) -> dict[str, int]:
    """Scheduled event → what was removed."""
    return asdict(Sweep(installed.platform()).run())
