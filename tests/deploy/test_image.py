"""The image of a project: what goes in, its Dockerfile, what it runs, and the two ways it is built."""

from __future__ import annotations

import asyncio
import json
import os
import random
import re
import shlex
import shutil
import stat
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
import yaml

from console.problem import Exit, Problem
from deploy.study.image import bundle, docker, files
from deploy.study.image.bundle import make_bundle
from deploy.study.image.files import Ignore, project_files
from deploy.study.image.follow import advice
from hippodrome.ports import PORTS
from tests.deploy.registering import LOG_GROUP, Town, docker_calls, fake_docker, folder, machine, town, write_study
from tests.trial.conftest import client_of, grid_agent
from trial import check

__all__ = ["folder", "machine", "town"]
ROOT = Path(__file__).resolve().parents[2]


# --- which files --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("app", ["App", "src/hippogym_app"])
def test_of_a_clone_of_hippo_gym_what_lies_beside_the_agent_goes_in(folder: Path, app: str) -> None:
    (folder / "agent.py").unlink()
    for name in ("agent.py", "coachAgent.py", "images/a.png", "maps/steps/b.txt", "README.md"):
        (folder / app / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / app / name).write_text(name)
    for name in ("Trials/episode_1_user_P1", "privkey.pem", "fullchain.pem", ".env", ".trialConfig.yml", "config.yml"):
        (folder / app / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / app / name).write_text("not this")
    (folder / "updateProject.py").write_text("not this")
    (folder / "StepFiles").mkdir()
    (folder / ".dockerignore").write_text(f"{app}/README.md\n")
    assert list(project_files(folder)) == ["agent.py", "coachAgent.py", "images/a.png", "maps/steps/b.txt"]
    (folder / "requirements.txt").write_text("gym==0.17.2\nnumpy==1.18.5\nshortuuid==1.0.1\n")
    bundle = make_bundle(folder)
    assert bundle.entries["requirements/project.txt"] == b"\n\nshortuuid==1.0.1\n"
    assert bundle.entries["project/agent.py"] == folder.resolve() / app / "agent.py"


@pytest.mark.parametrize("app", ["App", "src/hippogym_app"])
def test_recordings_and_keys_of_a_clone_stay_out_though_its_agent_has_moved_up(folder: Path, app: str) -> None:
    for name in ("Trials/episode_1_user_P1", "privkey.pem", "fullchain.pem", ".env", "data/map.txt"):
        (folder / app / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / app / name).write_text(name)
    assert set(project_files(folder)) == {f"{app}/data/map.txt", "agent.py"}


@pytest.mark.parametrize("link", ["App", "src"])
def test_a_folder_elsewhere_does_not_go_in_by_a_link(folder: Path, tmp_path: Path, link: str) -> None:
    (folder / "agent.py").unlink()
    elsewhere = tmp_path / "elsewhere"
    place = elsewhere if link == "App" else elsewhere / "hippogym_app"
    place.mkdir(parents=True)
    for name in ("agent.py", "diary.txt"):
        (place / name).write_text(name)
    (folder / link).symlink_to(elsewhere)
    with pytest.raises(Problem, match="is a link out of the project folder"):
        project_files(folder)


def test_what_is_elsewhere_hidden_or_made_by_machines_stays_out(folder: Path) -> None:
    write_study(
        folder,
        maps__one_DOT_txt="1",
        maps__steps__two_DOT_txt="2",
        maps__data__three_DOT_txt="3",
        data__maze__users__ada__answers__1_DOT_json="{}",
        **{"data-try__try-1__maze__users__bot__answers__1_DOT_json": "{}"},
        _DOT_git__HEAD="x",
        _DOT_env="AWS_SECRET_ACCESS_KEY=1",
        maps___DOT_hidden="x",
        __pycache____agent_DOT_pyc="x",
        old_DOT_pyc="x",
        venv__pyvenv_DOT_cfg="x",
        venv__lib__big_DOT_py="x",
        requirements_DOT_txt="numpy\n",
    )
    assert list(project_files(folder)) == ["agent.py", "maps/data/three.txt", "maps/one.txt", "maps/steps/two.txt"]


def test_a_dockerignore_leaves_out_more(folder: Path) -> None:
    write_study(
        folder,
        videos__a_DOT_mp4="x",
        deep__er__b_DOT_mp4="x",
        deep__er__keep_DOT_mp4="x",
        deep__c_DOT_txt="x",
        _DOT_dockerignore="# films\nvideos/\n**/*.mp4\n!deep/er/keep.mp4\n\n",
    )
    assert list(project_files(folder)) == ["agent.py", "deep/c.txt", "deep/er/keep.mp4"]


def test_what_is_hidden_cannot_be_taken_back(folder: Path) -> None:
    write_study(folder, _DOT_env="secret", _DOT_dockerignore="!.env\n!config.yml\n")
    assert list(project_files(folder)) == ["agent.py"]


def test_patterns_mean_what_they_mean_to_docker() -> None:
    oracle = pytest.importorskip("docker.utils.build").PatternMatcher
    chance = random.Random(7)
    names = ["a", "ab", "b.py", "c", "d.txt"]
    pieces = ["a", "a*", "*.py", "?", "c", "*", "[ab]b", "d.txt", "ab"]  # `**` is not right there
    for _ in range(4000):
        lines = []
        for _ in range(chance.randint(1, 3)):
            pattern = "/".join(chance.choice(pieces) for _ in range(chance.randint(1, 3)))
            lines.append(chance.choice(["", "", "!"]) + chance.choice(["", "/", "./"]) + pattern)
        path = "/".join(chance.choice(names) for _ in range(chance.randint(1, 4)))
        if any(line.lstrip("!").lstrip("./") == "" for line in lines):
            continue
        assert Ignore(lines)(path) == oracle(lines).matches(path), (lines, path)


@pytest.mark.parametrize(
    ("pattern", "yes", "no"),
    [
        ("**/a", ["a", "a/b", "x/y/a", "x/a/b"], ["ab", "x/ya"]),
        ("a/**", ["a/b", "a/b/c"], ["b/a", "ab"]),
        ("a/**/b", ["a/b", "a/x/b", "a/x/y/b/z"], ["a/xb", "b"]),
        ("**/*.go", ["x.go", "a/b/x.go"], ["x.gone", "go"]),
        ("**", ["a", "a/b"], []),
        ("*/temp*", ["x/temporary", "x/temp/a"], ["temp", "x/y/temp"]),
        ("[a-c].txt", ["b.txt"], ["d.txt", "x/b.txt"]),
        ("[^a].txt", ["b.txt"], ["a.txt", "/.txt"]),
        (r"a\*b", ["a*b"], ["axb"]),
        ("a[", ["a["], ["a"]),
    ],
)
def test_patterns(pattern: str, yes: list[str], no: list[str]) -> None:
    ignored = Ignore([pattern])
    assert [name for name in yes if not ignored(name)] == []
    assert [name for name in no if ignored(name)] == []


def test_links_within_the_folder_are_the_files_they_lead_to(folder: Path) -> None:
    write_study(folder, maps__one_DOT_txt="1")
    (folder / "two.txt").symlink_to(folder / "maps/one.txt")
    assert project_files(folder)["two.txt"].read_text() == "1"


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("/etc/passwd", "link out of the project folder"),
        ("../outside.txt", "link out of the project folder"),
        ("nowhere", "is not a file"),
        ("maps", "link to a folder"),
        (".env", "left out of the image"),
        ("data/maze/users/ada.json", "left out of the image"),
        ("data", "left out of the image"),
        (".", "link to a folder"),
        ("loop", "leads to itself"),
    ],
)
def test_other_links_are_refused(folder: Path, target: str, said: str) -> None:
    write_study(folder, maps__one_DOT_txt="1", _DOT_env="secret", data__maze__users__ada_DOT_json="{}")
    (folder.parent / "outside.txt").write_text("x")
    (folder / "loop").symlink_to("loop") if target == "loop" else (folder / "link").symlink_to(target)
    with pytest.raises(Problem, match=said):
        project_files(folder)


def test_a_link_out_of_the_folder_may_be_ignored(folder: Path) -> None:
    (folder / "link").symlink_to("/etc/passwd")
    (folder / ".dockerignore").write_text("link\n")
    assert list(project_files(folder)) == ["agent.py"]


def test_what_is_no_file_is_refused(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    with pytest.raises(Problem, match=r"pipe is not a file"):
        project_files(folder)


def test_too_much_names_the_biggest(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "LIMIT_BYTES", 5000)
    write_study(folder, a__model_DOT_bin="x" * 4000, notes_DOT_txt="y" * 3000)
    with pytest.raises(Problem, match="more than") as caught:
        project_files(folder)
    assert "a/model.bin" in caught.value.details[0]
    assert ".dockerignore" in caught.value.advice
    monkeypatch.setattr(files, "LIMIT_FILES", 2)
    with pytest.raises(Problem, match="more than 2 files"):
        project_files(folder)


def test_the_example_brings_only_its_agent() -> None:
    """The example project lies in the folder of Hippodrome itself."""
    assert list(project_files(ROOT)) == ["agent.py"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("-r more.txt", "another file"),
        ("-e .", "another file"),
        ("--constraint=c.txt", "another file"),
        ("./wheels/a.whl", "another file"),
        ("../a", "another file"),
        ("/opt/a", "another file"),
        ("mine @ file:///opt/mine", "another file"),
        ("git+https://example.org/a.git", "no git"),
        ("a @ git+ssh://git@example.org/a.git", "password|no git"),
        ("--find-links https://me:secret@example.org/wheels", "password"),
    ],
)
def test_requirements_that_cannot_be_met(folder: Path, line: str, said: str) -> None:
    write_study(folder, requirements_DOT_txt=f"numpy  # fine\n\n# ./comment\n{line}\n")
    with pytest.raises(Problem, match=rf"requirements\.txt:4: .*({said})"):
        make_bundle(folder)


@pytest.mark.parametrize(
    "line", ["numpy==2.4.6", "torch>=2,<3 ; python_version > '3'", "a @ https://example.org/a.zip", "a.b[c]"]
)
def test_requirements_that_can(folder: Path, line: str) -> None:
    write_study(folder, requirements_DOT_txt=line)
    assert make_bundle(folder).entries["requirements/project.txt"] == line.encode()


# --- the bundle ---------------------------------------------------------------------------------------------------


def test_the_same_files_are_the_same_bundle_wherever_they_lie(folder: Path, tmp_path: Path) -> None:
    other = tmp_path / "elsewhere"
    shutil.copytree(folder, other)
    os.utime(other / "agent.py", (1, 1))
    first, second = make_bundle(folder), make_bundle(other)
    assert first.hash == second.hash
    assert re.fullmatch("[0-9a-f]{12}", first.hash)
    for made, name in ((first, "a.zip"), (second, "b.zip")):
        made.write_zip(tmp_path / name)
    assert (tmp_path / "a.zip").read_bytes() == (tmp_path / "b.zip").read_bytes()


def test_every_part_of_the_image_counts(folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    here = tmp_path / "hippodrome"
    for part in ("infra/Dockerfile", "requirements/trial.txt", "protocol/trial.py", "trial/server/server.py"):
        (here / part).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / part, here / part)
    monkeypatch.setattr(bundle, "HERE", here)
    seen = {make_bundle(folder).hash}
    for file in (
        here / "infra/Dockerfile",
        here / "requirements/trial.txt",
        here / "protocol/trial.py",
        here / "trial/server/server.py",
        folder / "agent.py",
    ):
        file.write_text(file.read_text() + "\n")
        seen.add(make_bundle(folder).hash)
    write_study(folder, requirements_DOT_txt="numpy", agent_DOT_py="class Agent: pass")
    seen.add(make_bundle(folder).hash)
    (folder / "agent.py").rename(folder / "agent2.py")
    seen.add(make_bundle(folder).hash)
    (folder / "agent2.py").chmod(0o755)
    seen.add(make_bundle(folder).hash)
    assert len(seen) == 9


def test_what_is_not_in_the_image_does_not_count(folder: Path) -> None:
    before = make_bundle(folder).hash
    write_study(folder, config="project: {}", steps__consent_DOT_html="other", data__x="1", _DOT_git__HEAD="x")
    (folder / "agent.py").write_text("class Agent:\n    pass\n")
    assert make_bundle(folder).hash == before


def test_zip_and_folder_hold_the_same_and_everybody_may_read_it(folder: Path, tmp_path: Path) -> None:
    write_study(folder, tool="#!/bin/sh\n", private_DOT_txt="x")
    (folder / "tool").chmod(0o700)
    (folder / "private.txt").chmod(0o600)
    made = make_bundle(folder)
    made.write_folder(tmp_path / "context")
    made.write_zip(tmp_path / "context.zip")
    with zipfile.ZipFile(tmp_path / "context.zip") as archive:
        zipped = {
            info.filename: (info.external_attr >> 16, archive.read(info))
            for info in archive.infolist()
            if not info.is_dir()
        }
    there = [path for path in (tmp_path / "context").rglob("*") if path.is_file()]
    laid = {
        path.relative_to(tmp_path / "context").as_posix(): (path.stat().st_mode, path.read_bytes()) for path in there
    }
    assert zipped == laid
    assert stat.S_IMODE(laid["project/tool"][0]) == 0o755
    assert stat.S_IMODE(laid["project/private.txt"][0]) == 0o644


# --- the Dockerfile -----------------------------------------------------------------------------------------------


@dataclass
class Recipe:
    """A Dockerfile as far as ours goes: its instructions, and what they come to."""

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
    """The parts of the Dockerfile, each from its FROM; what stands before the first belongs to that."""
    first, *others = re.split(r"(?m)^(?=FROM )", (ROOT / "infra/Dockerfile").read_text())
    return [Recipe.of(first + others[0]), *map(Recipe.of, others[1:])]


@pytest.fixture(scope="module")
def recipe() -> Recipe:
    """What the image holds."""
    return stages()[0]


def test_the_dockerfile_is_one_that_may_run_a_strangers_code(recipe: Recipe) -> None:
    words = [word for word, _ in recipe.steps]
    known = {"ARG", "FROM", "ENV", "RUN", "COPY", "VOLUME", "WORKDIR", "USER", "EXPOSE", "STOPSIGNAL", "CMD"}
    assert set(words) == known  # no ADD, which fetches from the net; no ENTRYPOINT or HEALTHCHECK of our own
    user, _ = recipe.all("USER")[-1].split(":")
    assert user.isdecimal()
    assert int(user) > 0
    assert words.index("USER") > max(index for index, word in enumerate(words) if word in ("RUN", "COPY"))
    assert recipe.all("STOPSIGNAL") == ["SIGTERM"]
    assert not re.search(r"(?i)secret|password|AWS_", (ROOT / "infra/Dockerfile").read_text())
    (base,) = recipe.all("ARG")
    assert re.search(r":3\.13-slim-[a-z]+$", base)
    # Docker Hub answers 429 to the addresses that CodeBuild's builders share; AWS's mirror of the same images does not.
    assert base.removeprefix("BASE=").startswith("public.ecr.aws/docker/library/python:")


def test_the_dockerfile_and_the_task_definition_agree(recipe: Recipe) -> None:
    from deploy.study import definition

    assert recipe.all("USER") == [definition.USER]
    assert json.loads(recipe.all("VOLUME")[0]) == [definition.SCRATCH]
    assert recipe.env["TMPDIR"] == recipe.env["HOME"] == definition.SCRATCH
    assert recipe.all("EXPOSE") == [" ".join(map(str, PORTS))]


def test_the_dockerfile_runs_what_local_runs(recipe: Recipe) -> None:
    from local.backend.tasks import PYTHON_TRIAL

    command = json.loads(recipe.all("CMD")[0])  # the exec form: python itself gets SIGTERM, not a shell
    assert command == ["python", *(word for word in PYTHON_TRIAL[1:] if word != "-P")]
    assert recipe.env["PYTHONSAFEPATH"] == "1"  # what -P says
    assert recipe.all("WORKDIR") == [recipe.env["AGENT_DIR"]]


def test_the_agent_is_tried_in_a_stage_that_the_image_waits_for_and_takes_nothing_of(recipe: Recipe) -> None:
    """BuildKit skips a stage of which nothing is used: https://docs.docker.com/build/building/multi-stage/"""
    _, tried, last = stages()
    assert recipe.all("FROM") == ["${BASE} AS image"]
    assert tried.steps == [  # as the image's own user, with its variables
        ("FROM", "image AS tried"),
        ("COPY", "check.json /hippodrome/check.json"),
        ("RUN", '["python", "-m", "trial.check", "/hippodrome/check.json", "60"]'),
    ]
    same = "/hippodrome/requirements/trial.txt"
    assert last.steps == [("FROM", "image"), ("COPY", f"--from=tried {same} {same}")]
    assert ("requirements/trial.txt", same) in recipe.copies, "the file is that of the image"


def test_what_changes_least_comes_first(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    sources = [source for source, _ in recipe.copies]
    assert sources == ["requirements/trial.txt", "requirements/project.txt", "protocol/", "trial/", "project/"]
    runs = [index for index, (word, _) in enumerate(recipe.steps) if word == "RUN"]
    assert max(runs) < recipe.steps.index(("COPY", "protocol/ /hippodrome/protocol/"))
    make_bundle(folder).write_folder(tmp_path / "context")
    for source in sources:
        assert (tmp_path / "context" / source).exists()


def test_a_project_without_files_of_its_own_can_be_built(folder: Path, tmp_path: Path) -> None:
    (folder / "agent.py").unlink()
    made = make_bundle(folder)
    made.write_folder(tmp_path / "context")
    made.write_zip(tmp_path / "context.zip")
    assert (tmp_path / "context/project").is_dir()
    with zipfile.ZipFile(tmp_path / "context.zip") as archive:
        assert "project/" in archive.namelist()


def test_the_versions_of_the_trial_are_pinned() -> None:
    for line in (ROOT / "requirements/trial.txt").read_text().splitlines():
        assert line.startswith("#") or re.fullmatch(r"[A-Za-z0-9-]+==[0-9.]+", line)


def test_the_buildspec_is_one() -> None:
    spec = yaml.safe_load((ROOT / "infra/buildspec.yml").read_text())
    assert spec["version"] == 0.2
    commands = [command for phase in spec["phases"].values() for command in phase["commands"]]
    for command in commands:
        assert subprocess.run(["bash", "-n", "-c", command], check=False).returncode == 0
    (build,) = spec["phases"]["build"]["commands"]
    for cache, extra in (("", []), ("r/x:y", ["--cache-from", "type=registry,ref=r/x:y"])):
        said = subprocess.run(
            ["bash", "-c", f'docker() {{ printf "%s\\n" "$@"; }}; {build}'],
            env={"IMAGE": "r/x:z", "CACHE_FROM": cache, "PATH": os.environ["PATH"]},
            capture_output=True, text=True, check=True,
        ).stdout.split("\n")[:-1]  # fmt: skip
        assert said[:2] == ["buildx", "build"]
        assert said[-4:] == ["--tag", "r/x:z", "--push", "."]
        assert said[7 : 7 + len(extra)] == extra
        assert len(said) == 11 + len(extra)


class Container:
    """The image without Docker: what COPY copies, ENV sets and CMD runs, below a folder that stands for /."""

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
            env={**told, **env},  # and nothing of this machine
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


ENV = {
    "PROJECT_ID": "maze",
    "USER_ID": "P1",
    "SERVER": "s-1",
    "TOKEN": "the-secret-token",
    "GAME_STEPS": "3",
    "GROUP": "",
    "TRIAL": json.dumps({"game": "grid", "maxEpisodes": 1}),
    "HOST": "127.0.0.1",
    "PORT": "0",
    "TLS": "off",
    "LINGER_SECONDS": "0.2",
}


def test_what_the_image_holds_plays_a_game(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(
        folder,
        agent_DOT_py="import helper\n" + grid_agent(20).replace("self.env = Grid()", "self.env = helper.ready(Grid())"),
        helper_DOT_py="import pathlib\n\ndef ready(env):\n    assert pathlib.Path('maps/one.txt').read_text() == '1'\n    return env\n",
        maps__one_DOT_txt="1",
        json_DOT_py="raise SystemExit('a project must not stand in for Python')\n",
    )
    make_bundle(folder).write_folder(tmp_path / "context")
    container = Container(recipe, tmp_path / "context", tmp_path / "root", {**ENV, "STORE": str(tmp_path / "store")})
    try:
        address = f"ws://127.0.0.1:{container.port()}/"

        async def play() -> Any:
            async with client_of(address) as client:
                await client.play(3)
                await client.until(lambda: client.done)
                return client

        client = asyncio.run(play())
        assert client.frame is not None
        assert container.process.wait(20) == 0, container.process.communicate()
    finally:
        container.process.kill()
        container.process.communicate()
    answer = json.loads((tmp_path / "store/maze/users/P1/answers/3.json").read_text())
    assert answer["answers"]["episodes"] == 1
    assert container.files() == container.before  # nothing is written but below /scratch


def test_sigterm_ends_what_the_image_runs(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py=grid_agent(None))
    make_bundle(folder).write_folder(tmp_path / "context")
    container = Container(recipe, tmp_path / "context", tmp_path / "root", {**ENV, "STORE": str(tmp_path / "store")})
    try:
        container.port()
        container.process.terminate()
        assert container.process.wait(20) == 0
    finally:
        container.process.kill()
        container.process.communicate()


# --- trying the agent ---------------------------------------------------------------------------------------------


def tried(recipe: Recipe, folder: Path, tmp_path: Path, seconds: str = "30", **trial: Any) -> tuple[int, str]:
    """The exit status and output of the step that tries the agent, where the image's files are."""
    make_bundle(folder, trial=trial).write_folder(tmp_path / "context")
    (command,) = (json.loads(step) for step in stages()[1].all("RUN"))
    assert command[3:] == ["/hippodrome/check.json", "60"]
    command[3:] = [str(tmp_path / "context/check.json"), seconds]
    container = Container(recipe, tmp_path / "context", tmp_path / "root", {}, command)
    said, wrong = container.process.communicate(timeout=60)
    assert wrong == ""
    assert container.files() == container.before
    assert len(said.splitlines()) == 1
    return container.process.returncode, said


WELL = "The agent was tried in the image: it starts, draws and takes a step.\n"


def test_an_agent_that_plays_passes(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py="print('much', 'more', sep='\\n')\n" + grid_agent(20))
    assert tried(recipe, folder, tmp_path, game="grid") == (0, WELL)


DRAWN = """
class Agent:
    def start(self, game): pass
    def reset(self, seed=None): pass
    def step(self, action): return None, 0.0, False, False, {}
    def render(self): return [{"id": "ball", "type": "circle", "x": 0.5, "y": 0.5, "radius": 9}]
    def close(self): pass
"""


def test_an_agent_that_draws_objects_passes(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py=DRAWN)
    assert tried(recipe, folder, tmp_path, game="ball", scene={"width": 300, "height": 200}) == (0, WELL)


OLD_GYM_AGENT = """
import gym

class Agent:
    def start(self, game):
        self.env = gym.make(game)
    def step(self, action):
        observation, reward, done, info = self.env.step(action)
        return {"observation": observation, "reward": reward, "done": done, "info": info}
    def render(self):
        return self.env.render("rgb_array")
    def reset(self):
        self.env.reset()
    def close(self):
        self.env.close()
"""


def test_an_agent_that_imports_gym_passes(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py=OLD_GYM_AGENT)
    assert tried(recipe, folder, tmp_path, game="MsPacman-v0") == (0, WELL)


def test_the_agent_is_told_its_game_and_options(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    said = "import json, os\nassert json.loads(os.environ['TRIAL']) == {'game': 'grid', 'options': {'speed': 3}}\n"
    write_study(folder, agent_DOT_py=said + grid_agent(20))
    found = tried(recipe, folder, tmp_path, game="grid", options={"speed": 3}, maxEpisodes=4)
    assert found == (0, WELL)


def test_a_project_without_an_agent_is_tried_with_its_game(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    (folder / "agent.py").unlink()
    status, said = tried(recipe, folder, tmp_path, game="nosuch/Game-v1")
    assert (status, "NamespaceNotFound" in said, "import it in agent.py, or correct its name" in said) == (
        1,
        True,
        True,
    )


DRAWS = "        return self.env.render()\n"
LIBRARY = "libGL.so.1: cannot open shared object file: No such file or directory"
LATE = """try:
            import pygame_of_nobody
        except ImportError as error:
            raise gymnasium.error.DependencyNotInstalled("not there") from error"""


@pytest.mark.parametrize(
    ("first", "drawing", "what", "remedy"),
    [
        ("import nosuch.part", "", "agent.py:1: ModuleNotFoundError: No module named 'nosuch'",
         "write the package that brings nosuch into requirements.txt beside agent.py"),
        ("", "import nosuch.part", "ModuleNotFoundError: No module named 'nosuch'",
         "write the package that brings nosuch into requirements.txt beside agent.py"),
        ("import ctypes; ctypes.CDLL('libnosuch.so.1')", "", "agent.py:1: OSError: libnosuch.so.1: cannot open",
         "libnosuch.so.1 is a system library"),
        ("", f"raise ImportError({LIBRARY!r})", f"ImportError: {LIBRARY}", "libGL.so.1 is a system library"),
        ("from json import nosuch", "", "agent.py:1: ImportError: cannot import name 'nosuch'",
         "correct the packages and versions in requirements.txt"),
        ("import gymnasium", LATE, "DependencyNotInstalled: not there",
         "write the package that brings pygame_of_nobody into requirements.txt"),
        ("import gymnasium; gymnasium.make('NoSuch-v0')", "", "agent.py:1: NameNotFound", "write the package with this game"),
    ],
)  # fmt: skip
def test_what_the_image_lacks_ends_its_build(
    recipe: Recipe, folder: Path, tmp_path: Path, first: str, drawing: str, what: str, remedy: str
) -> None:
    agent = grid_agent(20)
    assert agent.count(DRAWS) == 1
    write_study(folder, agent_DOT_py=f"{first}\n" + agent.replace(DRAWS, f"        {drawing or 'pass'}\n{DRAWS}"))
    status, said = tried(recipe, folder, tmp_path, game="grid")
    assert status == 1, said
    assert said.startswith("MISSING IN THE IMAGE: agent.py:")
    told, _, do = said.partition(" => ")
    assert what in told
    assert do.startswith(remedy)


SEVERAL = """
class Agent:
    possible_agents = ["left", "right"]
    def start(self, game):
        pass
    def reset(self, seed=None):
        return {"left": [1, 0], "right": [0, 1]}, {}
    def step(self, actions):
        return {"left": [1, 0], "right": [0, 1]}, {}, {}, {}, {}
    def render(self):
        import numpy
        return numpy.zeros((4, 4, 3), numpy.uint8)
    def close(self):
        pass

class Partner:
    def act(self, observation, info):
        assert observation == [0, 1]
        return 1

class Lost:
    def __init__(self):
        import nosuch
    def act(self, observation, info):
        return 0
"""


@pytest.mark.parametrize(
    ("plays", "file", "status", "words"),
    [
        ("agent:Partner", "", 0, WELL),
        ("random", "", 0, WELL),
        ("agent:Lost", "", 1, "No module named 'nosuch' => write the package that brings nosuch into requirements.txt"),
        (
            "policies/p.onnx",
            "",
            1,
            "right cannot be played by policies/p.onnx: there is no file policies/p.onnx => put the file there",
        ),
        ("policies/p.onnx", "no ONNX", 0, "right cannot be played by policies/p.onnx: policies/p.onnx is no ONNX file"),
    ],
)
def test_policies_are_tried_too(
    recipe: Recipe, folder: Path, tmp_path: Path, plays: str, file: str, status: int, words: str
) -> None:
    write_study(folder, agent_DOT_py=SEVERAL)
    if file:
        (folder / "policies").mkdir()
        (folder / "policies/p.onnx").write_text(file)
    team = {"left": "human", "right": plays}
    for name, players in {"all": team, "by group": {"0": {"left": "human", "right": "idle"}, "1": team}}.items():
        (tmp_path / name).mkdir()
        found, said = tried(recipe, folder, tmp_path / name, game="grid", players=players, actionSpace=["stay", "go"])
        assert (found, words in said) == (status, True), said


@pytest.mark.parametrize(
    ("first", "seconds", "words"),
    [
        ("import os; os.environ['nosuch']", "30", "agent.py:1: KeyError: 'nosuch'"),
        ("open('model.bin')", "30", "agent.py:1: FileNotFoundError"),
        ("import urllib.error; raise urllib.error.URLError('no network')", "30", "agent.py:1: URLError"),
        ("raise SystemExit(1)", "30", "agent.py:1: SystemExit"),
        ("import os; os._exit(7)", "30", "ended Python itself (status 7)"),
        ("import time; time.sleep(600)", "1", "has not come back within 1 s"),
        ("def f(:", "30", "SyntaxError"),
    ],
)
def test_what_a_server_may_have_and_a_build_has_not_is_a_warning(
    recipe: Recipe, folder: Path, tmp_path: Path, first: str, seconds: str, words: str
) -> None:
    write_study(folder, agent_DOT_py=f"{first}\n" + grid_agent(20))
    status, said = tried(recipe, folder, tmp_path, seconds, game="grid")
    assert status == 0
    assert said.startswith("Warning: the agent could not be tried in the image, which is built all the same: ")
    assert words in said


def test_what_the_agent_has_started_ends_with_the_step(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    started = "import subprocess, pathlib\nchild = subprocess.Popen(['/bin/sleep', '600'])\n"
    started += f"pathlib.Path({str(tmp_path / 'child')!r}).write_text(str(child.pid))\n"
    write_study(folder, agent_DOT_py=started + grid_agent(20))
    assert tried(recipe, folder, tmp_path, game="grid") == (0, WELL)
    child = Path("/proc", (tmp_path / "child").read_text(), "stat")
    until = time.monotonic() + 10
    while child.exists() and child.read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < until
        time.sleep(0.05)


def test_what_the_agent_is_tried_with_names_the_image_and_the_rest_of_the_section_does_not(folder: Path) -> None:
    names = [
        make_bundle(folder, trial=trial).hash
        for trial in (
            {"game": "a"},
            {"game": "b"},
            {"game": "a", "options": {"x": 1}},
            {"maxEpisodes": 2, "game": "a", "options": {}, "actionSpace": ["x"]},
            {"game": "a", "players": {"p": "random"}},
            {"game": "a", "players": {"p": "random"}, "actionSpace": ["x"]},
        )
    ]
    assert len(set(names)) == 5
    assert names[0] == names[3]


# --- CodeBuild ----------------------------------------------------------------------------------------------------


def test_a_build_is_told_everything_and_its_log_is_shown(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    (build,) = town.builds
    (tag,) = town.image_tags()
    assert build.env == {
        "IMAGE": f"{town.repository}:{tag}",
        "REGISTRY": town.repository.partition("/")[0],
    }, "a variable without a value may be refused, so there is no CACHE_FROM"
    assert build.asked["sourceLocationOverride"] == f"{town.env['BUCKET']}/_builds/{tag}.zip"
    assert yaml.safe_load(build.asked["buildspecOverride"])["version"] == 0.2
    assert "#12 pushing layers done" in ran.err
    (tmp := folder.parent / "b.zip").write_bytes(town.get(f"_builds/{tag}.zip"))
    with zipfile.ZipFile(tmp) as archive:
        assert "project/agent.py" in archive.namelist()
        assert json.loads(archive.read("check.json")) == {"game": "ALE/MsPacman-v5"}
        assert "project/config.yml" not in archive.namelist()


def test_layers_of_the_project_before_are_used(town: Town, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town.put_image("maze-aaaaaaaaaaaa")
    town.put_image("maze-two-bbbbbbbbbbbb")
    town.run(capsys, "register", str(folder))
    assert town.builds[0].env["CACHE_FROM"] == f"{town.repository}:maze-aaaaaaaaaaaa"


def test_layers_of_another_project_are_better_than_none(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    town.put_image("other-aaaaaaaaaaaa")
    town.run(capsys, "register", str(folder))
    assert town.builds[0].env["CACHE_FROM"] == f"{town.repository}:other-aaaaaaaaaaaa"


def test_a_failed_build_says_why_and_nothing_is_registered(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    town.outcome = "FAILED"
    town.log = [
        "#9 3.3 \x1b[31mERROR: No matching distribution found for nosuchthing==9\x1b[0m\x07",
        "\x1b]0;title\x07",
    ]
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    problem = ran.err[ran.err.index("✗") :]
    assert "#9 3.3 ERROR: No matching distribution found for nosuchthing==9" in problem
    assert "requirements.txt asks for nosuchthing==9" in problem
    assert "exit status 1" in problem
    assert "\x1b" not in ran.err
    assert "\x07" not in ran.err
    assert town.project() is None
    assert town.revisions() == []
    town.outcome = "SUCCEEDED"
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    assert len(town.builds) == 2
    assert town.made.count("s3:PutObject") == 4  # three pages and a bundle, none of them twice


BUILDKIT = [  # as BuildKit tells of a step that fails: as it comes, and once more at the end
    '#17 [tried 2/2] RUN ["python", "-m", "trial.check", "/hippodrome/check.json", "60"]',
    "#17 2.113 {line}",
    '#17 ERROR: process "python -m trial.check /hippodrome/check.json 60" did not complete successfully: exit code: 1',
    "------",
    " > [tried 2/2] RUN [...]:",
    "2.113 {line}",
    "------",
    'ERROR: failed to solve: process "python -m trial.check" did not complete successfully: exit code: 1',
]


@pytest.mark.parametrize(
    ("module", "package"), [("psutil", f"psutil=={version('psutil')}"), ("nosuch", "the package that brings nosuch")]
)
@pytest.mark.parametrize("on_aws", [True, False])
def test_what_the_image_lacks_is_one_sentence_and_what_to_do(
    town: Town,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    package: str,
    on_aws: bool,
) -> None:
    what = f"agent.py:3: ModuleNotFoundError: No module named '{module}'"
    line = f"{check.LACKS}{what}{check.REMEDY}write {check.PACKAGE}{module} into requirements.txt beside agent.py"
    log = [told.format(line=line) for told in BUILDKIT]
    town.outcome, town.log = "FAILED", log
    if not on_aws:
        town.docker = fake_docker(tmp_path / "bin", build=1, says="\n".join(log))
        path_with(monkeypatch, town.docker)
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    told = " ".join(ran.err[ran.err.index("✗") :].split())
    assert f"The image could not be built: {what}" in told
    assert told.endswith(f"Write {package} into requirements.txt beside agent.py; then run the same command again.")
    assert "ERROR" not in told, "the sentence is all"
    assert town.project() is None


@pytest.mark.parametrize(
    ("outcome", "said"),
    [("STOPPED", "build was stopped"), ("TIMED_OUT", "took too long"), ("FAULT", "could not be built")],
)
def test_other_ends_of_a_build(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str], outcome: str, said: str
) -> None:
    town.outcome = outcome
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert said in ran.err
    assert town.project() is None


def test_a_build_that_leaves_no_image_is_no_success(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A push that was cut off: layers without a manifest are no image."""
    town.push = False
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "not in the repository" in ran.err
    assert town.project() is None
    town.push = True
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE


def test_ctrl_c_leaves_the_build_running_and_the_next_run_joins_it(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.looks = 3

    def pressed(_: float) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("deploy.study.image.codebuild.time.sleep", pressed)
        ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.INTERRUPTED
    assert "goes on at AWS" in ran.err
    assert "Traceback" not in ran.err
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert "joining" in ran.err
    assert len(town.builds) == 1


def test_of_two_builds_of_the_same_image_the_first_counts(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its tag is given once: the push of the second is refused, and what is there is just what was wanted."""
    town.looks, town.outcome = 2, "FAILED"
    town.log = ["ERROR: tag invalid: The image tag already exists and cannot be overwritten because it is immutable"]
    monkeypatch.setattr(
        "deploy.study.image.codebuild.time.sleep",
        lambda _: town.put_image(town.builds[0].env["IMAGE"].rpartition(":")[2]),
    )
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert "meanwhile" in ran.err
    assert town.project() is not None


def test_another_content_is_another_build(town: Town, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town.looks = 10**6
    town.interrupt = 30
    town.run(capsys, "register", str(folder))
    assert len(town.builds) == 1
    town.interrupt, town.looks = None, 1
    (folder / "agent.py").write_text("class Agent:\n    x = 1\n")
    ran = town.run(capsys, "register", str(folder))
    assert "joining" not in ran.err
    assert len(town.builds) == 2


def test_an_account_without_builds(town: Town, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town.fail("codebuild:StartBuild", "AccountLimitExceededException", "Cannot have more than 0 builds in queue")
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "may not run another build now" in ran.err
    assert "quota" in ran.err


def test_a_log_group_that_may_not_be_read_is_told(town: Town, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    town.fail("logs:GetLogEvents", "AccessDeniedException", "no")
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "may not get log events" in ran.err
    assert town.client("logs").describe_log_groups(logGroupNamePrefix=LOG_GROUP)["logGroups"]


def test_an_image_can_be_built_anew(town: Town, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    first = town.project().task_definition
    assert town.run(capsys, "register", str(folder), "--rebuild").code == Exit.DONE
    plain, anew = town.image_tags()
    assert anew == f"{plain}.2"
    assert "CACHE_FROM" not in town.builds[1].env
    assert town.project().task_definition != first
    newest = town.project().task_definition
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    assert town.project().task_definition == newest  # and it stays with the newer one
    assert len(town.builds) == 2


@pytest.mark.parametrize(
    ("log", "said"),
    [
        ("ERROR: No matching distribution found for tensorfow", "requirements.txt asks for tensorfow"),
        ("ERROR: ResolutionImpossible: for help visit", "other versions than the trial needs"),
        ("error: command 'gcc' failed: No such file or directory", "no compiler"),
        ("toomanyrequests: Rate exceeded", "Wait a few minutes"),
        ("HEAD request to https://public.ecr.aws/v2/docker/library/python/manifests/x: 403 Forbidden", "docker logout"),
        ("write /x: no space left on device", "too large"),
        ("ERROR: Invalid requirement: 'numpy=2': Expected", "cannot read: numpy=2"),
        ("something else", "Mend what the log says"),
    ],
)
def test_advice(log: str, said: str) -> None:
    assert said in advice(log)


# --- Docker -------------------------------------------------------------------------------------------------------


def path_with(monkeypatch: pytest.MonkeyPatch, folder: Path) -> None:
    monkeypatch.setenv("PATH", str(folder))


def test_where_docker_runs_it_builds(
    town: Town, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.docker = fake_docker(tmp_path / "bin")
    path_with(monkeypatch, town.docker)
    town.put_image("maze-aaaaaaaaaaaa")
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert town.builds == []
    calls = docker_calls(town.docker)
    login = next(call for call in calls if call["words"][0] == "login")
    assert login["words"][-1] == town.repository.partition("/")[0]
    assert login["stdin"]
    assert not any(login["stdin"] in word for call in calls for word in call["words"])
    build = calls[-1]["words"]
    assert build[build.index("--platform") + 1] == "linux/amd64"
    assert build[build.index("--cache-from") + 1] == f"type=registry,ref={town.repository}:maze-aaaaaaaaaaaa"
    assert "--push" in build
    assert {"Dockerfile", "trial/__main__.py", "project/agent.py", "requirements/project.txt"} <= set(
        calls[-1]["files"]
    )
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    assert docker_calls(town.docker) == calls  # nothing is built twice


def test_docker_may_be_left_alone(
    town: Town, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.docker = fake_docker(tmp_path / "bin")
    path_with(monkeypatch, town.docker)
    assert town.run(capsys, "register", str(folder), "--build-on-aws").code == Exit.DONE
    assert len(town.builds) == 1
    assert docker_calls(town.docker) == []


def test_a_failing_docker_says_why(
    town: Town, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    town.docker = fake_docker(tmp_path / "bin", build=1, says="#7 ERROR: No matching distribution found for nosuch")
    path_with(monkeypatch, town.docker)
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "requirements.txt asks for nosuch" in ran.err
    assert town.project() is None


@pytest.mark.parametrize("there", [{"engine": False}, {"buildx": False}])
def test_docker_without_an_engine_or_buildx_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, there: dict[str, bool]
) -> None:
    path_with(monkeypatch, fake_docker(tmp_path / "bin", **there))
    assert not docker.available()


def test_no_docker_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path_with(monkeypatch, tmp_path)
    assert not docker.available()


def test_a_mirror_of_the_base_makes_another_image(tmp_path: Path) -> None:
    usual, mirrored = make_bundle(tmp_path), make_bundle(tmp_path, "mirror.example/python:3.13-slim")
    assert usual.hash != mirrored.hash
    assert b"\nARG BASE=mirror.example/python:3.13-slim\n" in mirrored.entries["Dockerfile"]
    with pytest.raises(Problem, match="no name of an image"):
        make_bundle(tmp_path, "x\nRUN evil")
