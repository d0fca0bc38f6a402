"""The image without Docker, for tests: the Dockerfile's instructions are read, and carried out in a folder."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Recipe:
    """A Dockerfile with the instructions that ours uses."""

    steps: list[tuple[str, str]] = field(default_factory=list)

    @classmethod
    def of(cls, text: str) -> Recipe:
        lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
        joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
        return cls(
            [(word.upper(), rest.strip()) for word, _, rest in (line.partition(" ") for line in joined.splitlines())]
        )

    def all(self, word: str) -> list[str]:
        return [rest for step, rest in self.steps if step == word]

    @property
    def env(self) -> dict[str, str]:
        return dict(part.split("=", 1) for rest in self.all("ENV") for part in shlex.split(rest))

    @property
    def copies(self) -> list[tuple[str, str]]:
        return [(source, target) for source, target in (shlex.split(rest) for rest in self.all("COPY"))]


def stages() -> list[Recipe]:
    """Return the stages of the Dockerfile, each from its FROM; what is before the first FROM belongs to the first."""
    first, *others = re.split(r"(?m)^(?=FROM )", (ROOT / "infra/Dockerfile").read_text())
    return [Recipe.of(first + others[0]), *map(Recipe.of, others[1:])]


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """What the image holds."""
    return stages()[0]


class Container:
    """The image without Docker: COPY, ENV and CMD are carried out below a folder that stands for /."""

    def __init__(
        self, recipe: Recipe, context: Path, root: Path, env: dict[str, str], command: list[str] | None = None
    ) -> None:
        for source, target in recipe.copies:
            place = root / target.lstrip("/")
            place.parent.mkdir(parents=True, exist_ok=True)
            if source.endswith("/"):
                shutil.copytree(context / source, place)
            else:
                shutil.copy(context / source, place)
        for volume in json.loads(recipe.all("VOLUME")[0]):
            (root / volume.lstrip("/")).mkdir()
        self.root = root
        self.before = self.files()
        told = {
            name: str(root / value.lstrip("/")) if value.startswith("/") else value
            for name, value in recipe.env.items()
        }
        command = command or json.loads(recipe.all("CMD")[0])
        assert command[0] == "python"
        self.process = subprocess.Popen(
            [sys.executable, *command[1:]],
            cwd=root / recipe.all("WORKDIR")[0].lstrip("/"),
            env={**told, **env},  # and no variables of this machine
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def files(self) -> set[str]:
        return {path.relative_to(self.root).as_posix() for path in self.root.rglob("*") if "scratch" not in path.parts}

    def port(self) -> int:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line, self.process.communicate()
        return int(json.loads(line)["port"])
