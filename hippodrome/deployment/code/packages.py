"""Third-party packages for the functions: pinned, downloaded as wheels for Lambda's platform, checked, and cached.

`requirements/packages.txt` pins everything that goes into a zip, with the hash of its wheel for Lambda. `python -m
hippodrome.deployment.code.packages` makes it from `lambdas.txt` and `deploy.txt`. pip downloads the wheels. It
evaluates environment markers for the machine it runs on and not for `--platform` (pypa/pip, issue 11664), so
dependencies are followed here.
"""

# ruff: noqa: PLC0415 - packaging is imported where it is needed, so that other commands start faster

from __future__ import annotations

import base64
import csv
import hashlib
import importlib.metadata
import io
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from email.parser import HeaderParser
from functools import cached_property
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING

from hippodrome import places
from hippodrome.console import screen
from hippodrome.console.problem import Problem

if TYPE_CHECKING:
    from packaging.requirements import Requirement

PINS = places.ROOT / "requirements" / "packages.txt"

# The distributions that Lambda's Python runtimes have: boto3 and its dependencies (AWS Lambda Developer Guide, "Runtime
# dependencies in Python", read November 2026).
IN_RUNTIME = {"boto3", "botocore", "jmespath", "python-dateutil", "s3transfer", "six", "urllib3"}

_GLIBC = range(34, 16, -1)  # Lambda's python3.13 runs on Amazon Linux 2023, which has glibc 2.34
_PIN_AGAIN = "`python -m hippodrome.deployment.code.packages`"
_ANEW = (
    f"Run `{shlex.quote(sys.executable)} -m pip cache purge`, then the same command again: it downloads the file anew."
)
_LEAVE_OUT = re.compile(  # not needed to run: stubs, C sources, tests, metadata
    r"(^|/)(tests?|__pycache__)/|\.(pyi|c|h|pyx|pxd|cpp|rs|pyc)$|(^|/)py\.typed$|^[^/]+\.dist-info/|\.libs/.*\.debug$"
)


@dataclass(frozen=True)
class Target:
    """The platform that runs the zips: a CPython version ("3.13") and a machine ("aarch64") with glibc, or this one."""

    python: str = "3.13"
    machine: str = "aarch64"
    local: bool = False  # this interpreter on this machine: for emulators that run functions as processes

    @classmethod
    def here(cls) -> Target:
        """Return the running interpreter as the target."""
        return cls(f"{sys.version_info.major}.{sys.version_info.minor}", platform.machine().lower(), local=True)

    @classmethod
    def from_env(cls) -> Target:
        """Return Lambda's platform; this machine if HIPPODROME_TARGET is `here`. Raises `Problem` for another value."""
        hippodrome_target = os.environ.get("HIPPODROME_TARGET", "")
        if hippodrome_target not in {"", "here", "lambda"}:
            raise Problem(f"HIPPODROME_TARGET is {hippodrome_target!r}.", "It may be `here`, `lambda` or unset.")
        return cls.here() if hippodrome_target == "here" else cls()

    def __str__(self) -> str:
        return f"{'here-' + sys.platform + '-' if self.local else ''}py{self.python}-{self.machine}"

    @property
    def pip_options(self) -> list[str]:
        """The options with which pip chooses wheels for this target."""
        if self.local:
            return []
        tags = [f"manylinux_2_{minor}_{self.machine}" for minor in _GLIBC] + [f"manylinux2014_{self.machine}"]
        options = ["--implementation", "cp", "--python-version", self.python]
        return options + [part for tag in tags for part in ("--platform", tag)]

    @property
    def markers(self) -> dict[str, str]:
        """The values of environment markers (PEP 508) on this target."""
        from packaging.markers import default_environment

        markers = {key: str(value) for key, value in default_environment().items()} | {"extra": ""}
        if self.local:
            return markers
        return markers | {
            "implementation_name": "cpython",
            "implementation_version": f"{self.python}.0",
            "os_name": "posix",
            "platform_machine": self.machine,
            "platform_python_implementation": "CPython",
            "platform_release": "",
            "platform_system": "Linux",
            "platform_version": "",
            "python_full_version": f"{self.python}.0",
            "python_version": self.python,
            "sys_platform": "linux",
        }


@dataclass(frozen=True)
class Pin:
    """The version of a distribution, and the sha256 of its wheel for Lambda ("" if not known)."""

    name: str
    version: str
    sha256: str = ""

    def __str__(self) -> str:
        return f"{self.name}=={self.version}"


@dataclass(frozen=True)
class ZipMember:
    """A file in a zip: its name there, its sha256, and how to read it."""

    name: str
    sha256: str
    load: Callable[[], bytes]

    def read(self) -> bytes:
        """Return the file's bytes. Raises `Problem` if their hash is not `sha256`."""
        body = self.load()
        if hashlib.sha256(body).hexdigest() != self.sha256:
            raise Problem(f"{self.name} changed while it was packed.", "Run the same command again.")
        return body


class Wheel:
    """A wheel in the cache. Its files were compared with its RECORD when it was downloaded."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @cached_property
    def members(self) -> Mapping[str, ZipMember]:
        """The files that go into a zip, by their names there."""
        wheel_members = {}
        for name, digest in self._record.items():
            place = _place(name)
            if place and digest and not _LEAVE_OUT.search(place):
                wheel_members[place] = ZipMember(place, digest, lambda name=name: self._zip.read(name))  # type: ignore[misc]
        return wheel_members

    @cached_property
    def modules(self) -> set[str]:
        """The names of its top-level modules."""
        tops = {PurePosixPath(name).parts[0] for name in self.members}
        return {top.split(".")[0] for top in tops if "." not in top or top.endswith((".py", ".so", ".pyd"))}

    def needs(self, target: Target) -> set[str]:
        """Return the normalized names of the distributions that the wheel needs on this target, without extras."""
        from packaging.utils import canonicalize_name

        requirements = self._requirements
        return {
            canonicalize_name(requirement.name)
            for requirement in requirements
            if not requirement.marker or requirement.marker.evaluate(target.markers)
        }

    @cached_property
    def _requirements(self) -> Sequence[Requirement]:
        from packaging.requirements import Requirement

        lines = HeaderParser().parsestr(self._text("METADATA")).get_all("Requires-Dist") or []
        return [Requirement(line) for line in lines]

    def check(self) -> None:
        """Compare every file with RECORD. Raises `Problem` if one differs, or the wheel cannot be read."""
        try:
            listed = self._record
            for name in self._zip.namelist():
                digest = listed.get(name)
                if name.endswith(("/", ".dist-info/RECORD", ".dist-info/RECORD.jws", ".dist-info/RECORD.p7s")):
                    continue
                if not digest or hashlib.sha256(self._zip.read(name)).hexdigest() != digest:
                    raise Problem(f"{self.path.name} is damaged: {name} is not what its RECORD says.", _ANEW)
        except (zipfile.BadZipFile, KeyError, ValueError, OSError) as error:
            raise Problem(f"{self.path.name} is not a sound wheel: {error}.", _ANEW) from None

    @cached_property
    def _zip(self) -> zipfile.ZipFile:
        return zipfile.ZipFile(self.path)

    @cached_property
    def _info(self) -> str:
        folders = {name.split("/")[0] for name in self._zip.namelist()}
        info_folders = [folder for folder in folders if folder.endswith(".dist-info")]
        if len(info_folders) != 1:
            raise ValueError("it must have exactly one .dist-info folder")
        return info_folders[0]

    def _text(self, name: str) -> str:
        return self._zip.read(f"{self._info}/{name}").decode()

    @cached_property
    def _record(self) -> dict[str, str]:
        """Read RECORD: by file, the sha256 in hexadecimal; "" for RECORD itself."""
        record = {}
        for row in csv.reader(io.StringIO(self._text("RECORD"))):
            if row:
                kind, _, value = row[1].partition("=")
                record[row[0]] = base64.urlsafe_b64decode(value + "==").hex() if kind == "sha256" else ""
        return record


def _place(name: str) -> str:
    """Return where a wheel's file is installed below site-packages; "" for scripts, headers and data (PEP 427)."""
    folder, _, rest = name.partition("/")
    if folder.endswith(".data"):
        kind, _, rest = rest.partition("/")
        name = rest if kind in {"purelib", "platlib"} else ""
    return "" if ".." in PurePosixPath(name).parts or name.startswith("/") else name


def read_pins(path: Path = PINS) -> dict[str, Pin]:
    """Return the pins of a requirements file, by normalized name; lines that are not `name==version` are left out."""
    from packaging.utils import canonicalize_name

    pins: dict[str, Pin] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        if match := re.match(r"([A-Za-z0-9._-]+)(?:\[[^]]*\])?==([^\s;#]+)(?:.*--hash=sha256:([0-9a-f]{64}))?", line):
            name = canonicalize_name(match[1])
            pins[name] = Pin(name, match[2], match[3] or "")
    return pins


class WheelCache:
    """The wheels of one target, downloaded when they are first asked for and kept in the user's cache."""

    def __init__(self, target: Target, pins: Mapping[str, Pin] | None = None, folder: Path | None = None) -> None:
        self.target = target
        self.pins = read_pins() if pins is None else pins
        self._folder = (folder or cache_folder() / "wheels") / str(target)
        self._wheels: dict[str, Wheel] = {}

    def wheels(self, names: Iterable[str]) -> dict[str, Wheel]:
        """Return the wheels of these distributions, by name.

        Raises `Problem` if one is not pinned or not downloaded.
        """
        pins = [self._pin(name) for name in sorted(names)]
        if missing := [pin for pin in pins if not self._find(pin)]:
            self._download(missing)
        return {pin.name: self._wheels[pin.name] for pin in pins}

    def closure(self, names: Iterable[str]) -> set[str]:
        """Return these distributions and all that they need, except those that Lambda's runtime has."""
        collected: set[str] = set()
        waiting = set(names) - IN_RUNTIME
        while new := waiting - collected:
            collected |= new
            waiting |= {need for wheel in self.wheels(new).values() for need in wheel.needs(self.target)} - IN_RUNTIME
        return collected

    @cached_property
    def owners(self) -> dict[str, str]:
        """Return, by top-level module, its distribution, for all pinned distributions."""
        return {module: name for name, wheel in self.wheels(self.pins).items() for module in wheel.modules}

    def _pin(self, name: str) -> Pin:
        try:
            return self.pins[name]
        except KeyError:
            raise Problem(
                f"The functions need {name}, which {PINS.name} does not pin.",
                "Run `python -m hippodrome.deployment.code.packages`, and commit what it changes.",
            ) from None

    def _find(self, pin: Pin) -> bool:
        if pin.name not in self._wheels:
            wheels = sorted((self._folder / self._key(pin)).glob("*.whl"))
            if not wheels:
                return False
            self._wheels[pin.name] = Wheel(wheels[0])
        return True

    def _key(self, pin: Pin) -> str:
        return f"{pin}-{pin.sha256[:16]}" if self._hashed(pin) else str(pin)

    def _hashed(self, pin: Pin) -> bool:
        """Whether the pin has the hash of this target's wheel. Only the wheels for Lambda are pinned with hashes."""
        return bool(pin.sha256) and self.target == Target()

    def _download(self, pins: list[Pin]) -> None:
        """Download wheels with one pip into a temporary folder, check each, and move it into the cache whole."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=self._folder, prefix="coming-") as coming:
            self._pip(pins, Path(coming))
            wheels = {_distribution(path): path for path in Path(coming).glob("*.whl")}
            for pin in pins:
                if pin.name not in wheels:
                    raise Problem(
                        f"pip did not bring a wheel of {pin} for {self.target}.",
                        f"Pin a version in requirements/ that has one, and run {_PIN_AGAIN}.",
                    )
                self._take_in(pin, wheels[pin.name])

    def _take_in(self, pin: Pin, path: Path) -> None:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if self._hashed(pin) and digest != pin.sha256:
            raise Problem(
                f"{path.name} is not the file that {PINS.name} pins: its sha256 is {digest}.",
                f"If the package's publisher added a wheel, run {_PIN_AGAIN} and read the diff.",
            )
        Wheel(path).check()
        place = self._folder / self._key(pin)
        parcel = path.parent / f"{pin}.parcel"
        parcel.mkdir()
        shutil.move(path, parcel / path.name)
        try:
            parcel.replace(place)
        except OSError:
            if not any(place.glob("*.whl")):  # otherwise another process has made it
                raise
        self._wheels[pin.name] = Wheel(place / path.name)

    def _pip(self, pins: list[Pin], folder: Path) -> None:
        command = [sys.executable, "-P", "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--no-input"]
        command += ["--disable-pip-version-check", "--progress-bar=off", "--dest", str(folder)]
        command += self.target.pip_options + [str(pin) for pin in pins]
        lines: list[str] = []
        with (
            screen.ProgressBars() as bar,
            subprocess.Popen(  # noqa: S603 - pip, with names and versions from our own pins
                command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
            ) as pip,
        ):
            task = bar.add_task(f"Downloading packages for {self.target}", total=len(pins))
            assert pip.stdout
            try:
                for line in pip.stdout:
                    lines.append(line.strip())
                    if line.startswith("Collecting "):
                        bar.advance(task)
            except BaseException:
                pip.terminate()
                raise
        if pip.returncode:
            error_lines = [line.removeprefix("ERROR: ") for line in lines if line.startswith("ERROR:")] or lines[-3:]
            raise Problem(
                f"The packages for {self.target} could not be downloaded.",
                "Check the network and pip's configuration, and try again: what has come is kept.",
                error_lines[:4],
            )


def cache_folder() -> Path:
    """Return Hippodrome's folder below the user's caches on this platform. It may be deleted at any time."""
    home = Path.home()
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "hippodrome"


def _distribution(path: Path) -> str:
    from packaging.utils import parse_wheel_filename

    return str(parse_wheel_filename(path.name)[0])


ALSO = ("acme", "cryptography", "josepy")  # distributions of deploy.txt that functions import too (renew_certificate)
SERVER = Target("3.13", "x86_64")
SERVER_PINS = places.ROOT / "requirements" / "image.txt"


def lock_functions() -> str:
    """Write the text of `packages.txt`."""
    direct = read_pins(places.ROOT / "requirements" / "lambdas.txt")
    deploy = read_pins(places.ROOT / "requirements" / "deploy.txt")
    pins = _closure(direct | {name: deploy[name] for name in ALSO if name in deploy}, Target(), IN_RUNTIME)
    return _text("Everything that may go into the functions' zips", "for Lambda", "lambdas.txt and deploy.txt", pins)


def lock_server() -> str:
    """Write the text of `image.txt`."""
    pins = _closure(read_pins(places.ROOT / "requirements" / "trial.txt"), SERVER, set())
    return _text("The trial's packages in the servers' image", "for Linux on x86-64", "trial.txt", pins)


def _closure(direct: Mapping[str, Pin], target: Target, left_out: set[str]) -> list[Pin]:
    """Pin all that these distributions need, in the versions installed here, with the hashes of the target's wheels."""
    pins, here, done = dict(direct), Target.here(), dict[str, Pin]()
    with tempfile.TemporaryDirectory() as folder:
        while names := set(pins) - set(done):
            for name, wheel in WheelCache(target, pins, Path(folder)).wheels(names).items():
                done[name] = Pin(name, pins[name].version, hashlib.sha256(wheel.path.read_bytes()).hexdigest())
                for need in (wheel.needs(target) | wheel.needs(here)) - left_out - set(pins):
                    pins[need] = Pin(need, importlib.metadata.version(need))
    return [pin for _, pin in sorted(done.items())]


def _text(what: str, where: str, sources: str, pins: Iterable[Pin]) -> str:
    head = (
        f"# {what}: exact versions, and the hash of the wheel {where}.\n"
        f"# Made from {sources} by `python -m hippodrome.deployment.code.packages`.\n"
    )
    return head + "".join(f"{pin} --hash=sha256:{pin.sha256}\n" for pin in pins)


if __name__ == "__main__":
    for file, text in ((PINS, lock_functions()), (SERVER_PINS, lock_server())):
        file.write_text(text, encoding="utf-8")
        screen.success(f"{file.name} holds {len(read_pins(file))} packages.")
