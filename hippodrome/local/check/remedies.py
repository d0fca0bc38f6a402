"""Advice for an agent.py that imports a package which is not installed, or a name which a package lacks."""

from __future__ import annotations

import re
from importlib import util

_INSTALL = re.compile(r"pip install [\"']?([\w.-]+(?:\[[\w.,-]+\])?)")
_UNREGISTERED = ("NameNotFound", "NamespaceNotFound", "UnregisteredEnv")
_MODULE = re.compile(r"No module named '(?P<module>[\w.]+)'")
_NAME = re.compile(r"cannot import name '(?P<name>\w+)' from '(?P<module>gym(\.\w+)*)'")
_ATTRIBUTE = re.compile(r"module '(?P<module>gym(\.\w+)*)' has no attribute '(?P<name>\w+)'")
_PACKAGES = {
    "cv2": "opencv-python-headless",
    "pygame": "pygame-ce",
    "skimage": "scikit-image",
    "sklearn": "scikit-learn",
}
"""Packages by their modules, where the names differ."""
_OLD = {
    "atari_py": "ale_py stands in for it",
    "baselines": "it needs TensorFlow 1 and Python 3.7: use stable_baselines3",
    "stable_baselines": "it needs TensorFlow 1 and Python 3.7: use stable_baselines3",
}
"""Modules from the time of HIPPO Gym that have no versions for the Pythons of Hippodrome."""


def remedy(kind: str, text: str, game: str = "Id-v0") -> str:
    """Return advice to append to an error's text, beginning with a semicolon; "" if there is none for this error.

    `kind` is the name of the exception's class, and `game` the id of the environment.
    """
    if kind == "DependencyNotInstalled":  # the error's text names the packages, as Gymnasium calls them
        commands = _INSTALL.findall(text)  # the last one is Gymnasium's own, with what the game needs
        package = f": {commands[-1]}" if commands else ""
        return f"; instead of installing it by hand, name it in a requirements.txt beside agent.py{package}"
    if kind in _UNREGISTERED:
        return "" if "Did you mean" in text else _of_id(game)
    lacking = _NAME.search(text) or _ATTRIBUTE.search(text)
    if lacking and kind in ("ImportError", "AttributeError"):
        return _of_gym(f"{lacking['module']}.{lacking['name']}")
    match = _MODULE.search(text)
    return _of_module(match["module"]) if match and kind == "ModuleNotFoundError" else ""


def _of_id(game: str) -> str:
    """Advice for an id that Gymnasium does not have: other packages register their environments when imported."""
    module = re.split("[-/]", game)[0].lower()
    module = module if module.isidentifier() and util.find_spec(module) else "MODULE"
    return (
        f"; if another package has it, write the package's module before it (game: {module}:{game}), and the package "
        "into a requirements.txt beside agent.py"
    )


def _of_module(module: str) -> str:
    package = module.partition(".")[0]
    if package == "gym":
        return _of_gym(module)
    if package in _OLD:
        return f"; {_OLD[package]}"
    if module != package and util.find_spec(package):
        return f"; the {package} that is installed does not have it"
    return f"; name its package in a requirements.txt beside agent.py: {_PACKAGES.get(package, package)}"


def _of_gym(name: str) -> str:
    """Advice for a name that Gym had and Hippodrome's replacement of it lacks (`hippodrome/trial/agent/old_gym`)."""
    if util.find_spec("gym"):  # Gym itself is installed
        return ""
    return f"; what stands in for Gym here has no {name}: use Gymnasium's, or leave it out (docs/hippo.md#agents)"
