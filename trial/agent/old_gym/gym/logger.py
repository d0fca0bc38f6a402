"""Gym's logger, by means of Gymnasium's."""

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
    """Log nothing below this level."""
    logger.min_level = level


setLevel = set_level  # noqa: N816 - Gym has both names


def debug(text: str, *values: Any) -> None:
    """Do nothing: Gym shows such messages only at its lowest levels."""


info = debug
