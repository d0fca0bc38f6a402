"""Only until `local/publish.py` imports FOLDERS from `hippodrome.config`."""

from hippodrome.config import FOLDERS

__all__ = ["FOLDERS"]
