"""The packages of an image, resolved and installed by uv for the servers' Python and platform.

uv evaluates environment markers for the target, and pip for the machine on which it runs (pypa/pip, issue 11664). The
trial's packages are pinned with hashes in `requirements/image.txt`; a study's own are resolved together with them,
once, and stay as they are until its requirements.txt changes or `register --rebuild` looks anew.
"""

# ruff: noqa: S603 - uv, with arguments as a list that no shell reads

from __future__ import annotations

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hippodrome import places
from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.deployment.code import bytecode

PYTHON = "3.13"
BASE = "hippodrome/packages"  # the user base (PYTHONUSERBASE): it depends on no base's place of Python's own packages
SITE = f"{BASE}/lib/python{PYTHON}/site-packages"

# The base has glibc 2.41. Packages for an older one can also be tried on this machine.
_TARGET = ("--python-platform", "x86_64-manylinux_2_34", "--python-version", PYTHON)
# Written anew by each installation, or with this machine's paths in it.
_VARIES = re.compile(r"(^|/)(\.lock|[^/]+\.dist-info/(INSTALLER|REQUESTED|RECORD|direct_url\.json|uv_cache\.json))$")
# What servers do not need of the trial's packages. Those of a study stay whole: nobody here knows them.
_NEEDLESS = re.compile(r"(^|/)tests?/|\.(pyi|h|c|cpp|pyx|pxd|a)$|\.libs/.*\.debug$")
_TRIALS = "the trial's packages"
_COMPILER = "public.ecr.aws/docker/library/python:3.13-trixie"


@dataclass(frozen=True)
class Packages:
    """Installed packages: whose they are, a key that says what they are, and a folder like site-packages."""

    name: str
    key: str
    folder: Path

    @property
    def entries(self) -> dict[str, Path | bytes]:
        """The files by their paths in the image."""
        files = (path for path in self.folder.rglob("*") if path.is_file())
        return {f"{SITE}/{path.relative_to(self.folder).as_posix()}": path for path in files}


def install(requirements: str, cache: Path, *, fresh: bool = False) -> list[Packages]:
    """Install the trial's packages and those of a study's requirements.txt, each set in a folder of the cache.

    The first set is the trial's, which all studies share, unless the study needs another version of what the trial's
    packages bring along; then all packages are one set. `fresh`: resolve anew. Raises `Problem` if packages do not fit
    together, cannot be downloaded, or have no wheel for the servers and would have to be compiled.
    """
    lock = (places.ROOT / "requirements/image.txt").read_text(encoding="utf-8")
    if not _lines(requirements):
        return [_installed(_TRIALS, lock, cache, slim=True)]
    options = "".join(f"{line}\n" for line in _lines(requirements) if line.startswith("-"))
    pins = _resolved(lock, requirements, cache, fresh)
    known, wanted = _pins(lock), _pins(pins)
    if not known.keys() <= wanted.keys() or any(_version(known[name]) != _version(wanted[name]) for name in known):
        return [_installed("all packages", options + pins, cache)]
    own = "".join(f"{wanted[name]}\n" for name in wanted if name not in known)
    studys = [_installed("the study's packages", options + own, cache)] if own else []
    return [_installed(_TRIALS, lock, cache, slim=True), *studys]


def _resolved(lock: str, requirements: str, cache: Path, fresh: bool) -> str:
    """Return the pins of all packages. uv prefers the versions of the lock, where the study does not need others."""
    trial = (places.ROOT / "requirements/trial.txt").read_text(encoding="utf-8")
    file = cache / "pins" / f"{_hash(*_TARGET, lock, trial, requirements)}.txt"
    if fresh or not file.is_file():
        file.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix="coming-") as coming:
            folder = Path(coming)
            (folder / "trial.txt").write_text(trial, encoding="utf-8")
            (folder / "requirements.txt").write_text(requirements, encoding="utf-8")
            (folder / "pins").write_text(re.sub(r" --hash=\S+", "", lock), encoding="utf-8")
            hashes = ["--generate-hashes"] if "--hash=" in requirements else []
            names = ["--no-header", "--no-annotate", "--output-file", "pins", "trial.txt", "requirements.txt"]
            _uv(["compile", *_TARGET, *hashes, *names], folder)
            os.replace(folder / "pins", file)
    os.utime(file)
    return file.read_text(encoding="utf-8")


def _installed(name: str, pins: str, cache: Path, *, slim: bool = False) -> Packages:
    python = bytecode.compiler(PYTHON)
    key = _hash(*_TARGET, pins, str(slim), str(python is not None))
    place = cache / "packages" / key
    if not place.is_dir():
        place.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache, prefix="coming-") as coming:
            folder = Path(coming, "site")
            Path(coming, "requirements.txt").write_text(pins, encoding="utf-8")
            options = ["--no-deps", "--target", "site", "--link-mode", "copy", "--requirements", "requirements.txt"]
            _uv(["install", *_TARGET, *options], Path(coming))
            shutil.rmtree(folder / "bin", ignore_errors=True)  # scripts with the path of this machine's Python
            for path in [path for path in folder.rglob("*") if path.is_file()]:
                inner = path.relative_to(folder).as_posix()
                if _VARIES.search(inner) or (slim and _NEEDLESS.search(inner)):
                    path.unlink()
            if python:
                bytecode.compile_folder(folder, f"/{SITE}", python)
            try:
                folder.replace(place)
            except OSError:
                if not place.is_dir():  # otherwise another process has made it
                    raise
    os.utime(place)
    return Packages(name, key, place)


def _uv(words: list[str], folder: Path) -> None:
    """Run `uv pip`. Raises `Problem` if it fails."""
    import uv  # noqa: PLC0415 - only `register` needs it, and only for a new image

    command = [uv.find_uv_bin(), "pip", words[0], "--quiet", "--no-progress", "--color", "never"]
    # As pip does: the best version of all indexes, and the certificates that this machine trusts.
    command += ["--index-strategy", "unsafe-best-match", "--python", sys.executable, *_index(), *words[1:]]
    environment = {**os.environ, "UV_SYSTEM_CERTS": "true", "UV_NATIVE_TLS": "true"}
    screen.info("Fetching packages …" if words[0] == "install" else "Choosing the versions of packages …")
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise explained(done.stderr)


def _index() -> list[str]:
    """Return the index that pip is configured for as uv's option: uv does not read pip's configuration.

    pip's further indexes are left out: such as piwheels, they are for this machine, and not for the servers.
    """
    command = [sys.executable, "-P", "-m", "pip", "config", "list", "--disable-pip-version-check"]
    printed = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    urls = re.findall(r"(?m)^[\w:.]+\.index-url='(.*)'$", printed)
    return ["--default-index", urls[-1]] if urls else []  # variables come last, and count more than files


def explained(output: str) -> Problem:
    """Return the problem for what uv has said."""
    lines = [line.strip() for line in output.splitlines() if line.strip()]
    details = [line for line in lines if re.match(r"error:|cause:|hint:", line)][:6] or lines[:6]
    text = " ".join(lines)
    if match := re.search(r"Request failed|error sending request|Failed to fetch|dns error", text):
        return Problem("The packages could not be downloaded.", "Check the network, and try again.", details)
    if match := re.search(r"Failed to (?:download and )?build `([^`]+)`", text):
        return Problem(
            f"{match[1]} has no wheel for Python {PYTHON} on Linux and would have to be compiled.",
            f"Choose a version that has one; or let Docker, Podman or Buildah compile it: --docker --base {_COMPILER}.",
            details,
        )
    if match := re.search(
        r"(\S+) was not found in the (?:package registry|provided package locations)|there is no version of (\S+)", text
    ):
        name = match[1] or match[2]
        return Problem(
            "A package cannot be found.",
            f"requirements.txt asks for {name}, which does not exist for Python {PYTHON} on Linux. Correct its name or "
            "version.",
            details,
        )
    if "No solution found" in text:
        return Problem(
            "The packages of requirements.txt do not fit together, or not with the trial's (requirements/trial.txt).",
            "Relax the versions that requirements.txt asks for.",
            details,
        )
    return Problem("The packages could not be installed.", "Correct requirements.txt.", details)


def _lines(requirements: str) -> list[str]:
    """Return the lines without comments; a line that goes on after a backslash is one."""
    text = re.sub(r"\\\n\s*", "", requirements)
    lines = (re.sub(r"(^|\s+)#.*$", "", line).strip() for line in text.splitlines())
    return [line for line in lines if line]


def _pins(text: str) -> Mapping[str, str]:
    """Return the lines that pin a package, by its name."""
    lines = (line for line in _lines(text) if not line.startswith("-"))
    return {re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0].lower(): line for line in lines}


def _version(pin: str) -> str:
    return pin.partition(" ")[0]


def _hash(*parts: str) -> str:
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]
