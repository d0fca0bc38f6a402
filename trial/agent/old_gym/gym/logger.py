"""Gym's logger, on Gymnasium's."""

from typing import Any

from gymnasium import logger
from gymnasium.logger import deprecation, error, warn
from gymnasium.utils import colorize

__all__ = [
    "DEBUG",
    "DISABLED",
    "ERROR",
    "INFO",
    "WARN",
    "colorize",
    "debug",
    "deprecation",
    "error",
    "info",
    "set_level",
]
__all__ += ["setLevel", "warn"]

DEBUG, INFO, WARN, ERROR, DISABLED = 10, 20, 30, 40, 50


def set_level(level: int) -> None:
    """Say nothing below this level."""
    logger.min_level = level


setLevel = set_level  # noqa: N816 - Gym has both names


def debug(text: str, *values: Any) -> None:
    """Gym shows this only at its lowest level; here it is never shown."""


info = debug
