"""Finds the files of an experiment, and writes those of its project."""

from __future__ import annotations

import ast
import hashlib
import json
import re
import sys
import sysconfig
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from hippodrome.protocol.players import ONNXRUNTIME
from hippodrome.trial.interactive_gym.objects import fields_of
from hippodrome.trial.interactive_gym.options import Unplayable

IMAGES = (".png", ".jpg", ".jpeg", ".webp")
MAX_BYTES = 500 * 2**20
"""The most bytes of all files of an experiment."""
_HASHES = ".made-by-interactive-gym.json"
"""The file of a project's folder that names the files that were made there, with their hashes."""
_SERVERS = ("", "server", "interactive_gym/server")  # Interactive Gym's assets are in its server's folder
_TRIAL = Path(__file__).resolve().parents[1]
_INSTALLED = _TRIAL, _TRIAL.parent / "protocol", Path(sysconfig.get_path("stdlib")).resolve()


def locate(name: str) -> Path | None:
    """Return the file that an option or a page names, as Interactive Gym finds it; None if there is none."""
    return next((path for folder in _SERVERS if (path := Path(folder, name)).is_file()), None)


def put(file: Path, folder: str, files: dict[str, bytes]) -> str:
    """Add a file to this folder of the project's `files`, and return its name there.

    The name gets a number if the folder has another file of this name.
    """
    data, name, number = file.read_bytes(), file.name, 1
    while files.get(f"{folder}/{name}", data) != data:
        number += 1
        name = f"{file.stem}-{number}{file.suffix}"
    files[f"{folder}/{name}"] = data
    return name


def assets(specs: Iterable[Any], remark: Callable[[str], None]) -> dict[str, bytes]:
    """Return the files of `assets/` by their paths. Call `remark` with a sentence about each image that is left out."""
    files: dict[str, bytes] = {}
    for spec in map(fields_of, specs):
        name, image, atlas = str(spec["name"]), locate(spec["img_path"]), spec.get("atlas_path")
        stem = name.rpartition(".")[0] if Path(name).suffix.lower() in IMAGES else name
        if image is None:
            remark(f"the image {name!r} is not found at {spec['img_path']}; sprites that show it are grey boxes")
            continue
        files[f"assets/{stem}{image.suffix.lower()}"] = image.read_bytes()
        if atlas is not None and (path := locate(atlas)) is not None:
            frames = json.loads(path.read_bytes())
            if textures := frames.get("textures"):  # Phaser's atlas of several images: the first one is drawn
                frames = {"frames": textures[0]["frames"]}
            files[f"assets/{stem}.json"] = json.dumps(frames).encode()
    return files


def own_files(script: Path, modules_before: Iterable[str], target: Path) -> dict[str, bytes]:
    """Return the experiment's own files by their paths in the project `target`.

    They are all files in the script's folder, and the modules that the script has imported, unless they are installed:
    `modules_before` were imported before. Raises Unplayable if the files are too large.
    """
    root = Path.cwd()
    paths = {path.relative_to(root): path for path in _beside(script.parent, target)}
    for name in sys.modules.keys() - set(modules_before):
        file = getattr(sys.modules[name], "__file__", None)
        if not file or not file.endswith(".py") or _is_installed(Path(file)):
            continue
        place = Path(*name.split("."), "__init__.py" if file.endswith("__init__.py") else "").with_suffix(".py")
        if file.endswith(str(place)):  # not loaded from a file by its path
            paths[place] = Path(file)
    if sum(path.stat().st_size for path in paths.values()) > MAX_BYTES:
        raise Unplayable(f"{script.parent} holds more than 500 MB: put the experiment into a folder of its own")
    return {place.as_posix(): path.read_bytes() for place, path in paths.items()}


def _beside(folder: Path, target: Path) -> Iterator[Path]:
    """Yield the files in the folder and below it, without hidden files, data, virtual environments and projects."""
    for path in sorted(folder.iterdir()):
        if path.name in ("__pycache__", "data") or path.name.startswith(".") or path == target or path.is_symlink():
            continue
        if path.is_dir() and not (path / "pyvenv.cfg").exists() and not (path / _HASHES).exists():
            yield from _beside(path, target)
        elif path.is_file():
            yield path


def _is_installed(file: Path) -> bool:
    """Whether a module belongs to Python, to a package or to Hippodrome."""
    packages = {"site-packages", "dist-packages"} & set(file.parts)
    return bool(packages) or any(file.resolve().is_relative_to(folder) for folder in _INSTALLED)


def requirements(files: Mapping[str, bytes], others: Iterable[str]) -> bytes:
    """Write requirements.txt: the packages that the modules import, in the versions here, and the lines `others`.

    Hippodrome itself is left out: the servers' image has it, and a package index may not.
    """
    names = {name for path, data in files.items() if path.endswith(".py") for name in _imports(data)}
    distributions = metadata.packages_distributions()
    packages = {package for name in names - {"hippodrome"} for package in distributions.get(name, ())[:1]}
    lines = [f"{package}=={metadata.version(package)}" for package in sorted(packages)]
    if any(path.endswith(".onnx") for path in files):
        lines.append(ONNXRUNTIME)
    by_package = {re.sub("[-_.]+", "-", re.split(r"[^\w.-]", line)[0]).lower(): line for line in (*lines, *others)}
    return "".join(f"{line}\n" for line in by_package.values()).encode()


def _imports(source: bytes) -> Iterator[str]:
    """Yield the top-level names of the modules that a module imports; none if this Python cannot read it.

    The script has imported what it needs, so such a module is another one of its folder, as for Python 2.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def write(folder: Path, files: Mapping[str, bytes]) -> list[str]:
    """Write the files of a project, and remove the files that only its earlier version had.

    A file that was changed by hand stays as it is. Return a sentence about each file that was not written for
    this reason. Raises Unplayable if the folder has files in it and none of them was made here, and OSError.
    """
    hashes = folder / _HASHES
    if folder.exists() and any(folder.iterdir()) and not hashes.is_file():
        raise Unplayable(f"{folder} holds something else; give another folder with --project")
    before: dict[str, str] = json.loads(hashes.read_text()) if hashes.is_file() else {}
    now = {name: _hash(data) for name, data in files.items()}
    sentences = []
    for name in before.keys() | now.keys():
        path = folder / name
        present = _hash(path.read_bytes()) if path.is_file() else before.get(name)
        if name in before and present not in (before[name], now.get(name)):
            sentences.append(f"{path} was changed by hand and stays; delete it to have it made again")
            now[name] = before[name]
        elif name in files:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(files[name])
        else:
            path.unlink(missing_ok=True)
    hashes.write_text(json.dumps(now, indent=0, sort_keys=True))
    return sorted(sentences)


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
