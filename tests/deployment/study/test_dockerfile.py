"""The Dockerfile of a project's image, and the server that the image runs."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path
from typing import Any

from hippodrome.control.ports import PORTS
from hippodrome.deployment.study.image.bundle import make_bundle
from tests.deployment.recipe import Container, Recipe, stages
from tests.deployment.registering import write_study
from tests.trial.conftest import client_of, grid_agent

ROOT = Path(__file__).resolve().parents[3]


def test_the_dockerfile_is_one_that_may_run_a_strangers_code(recipe: Recipe) -> None:
    words = [word for word, _ in recipe.steps]
    known = {"ARG", "FROM", "ENV", "RUN", "COPY", "VOLUME", "WORKDIR", "USER", "EXPOSE", "STOPSIGNAL", "CMD"}
    assert set(words) == known  # no ADD, which can download; no ENTRYPOINT or HEALTHCHECK of our own
    user, _ = recipe.all("USER")[-1].split(":")
    assert user.isdecimal()
    assert int(user) > 0
    assert words.index("USER") > max(index for index, word in enumerate(words) if word in ("RUN", "COPY"))
    assert recipe.all("STOPSIGNAL") == ["SIGTERM"]
    assert not re.search(r"(?i)secret|password|AWS_", (ROOT / "infra/Dockerfile").read_text())
    (base,) = recipe.all("ARG")
    assert re.search(r":3\.13-slim-[a-z]+$", base)
    # Docker Hub limits anonymous pulls per address; AWS's mirror of the same images does not.
    assert base.removeprefix("BASE=").startswith("public.ecr.aws/docker/library/python:")


def test_the_dockerfile_and_the_task_definition_agree(recipe: Recipe) -> None:
    from hippodrome.deployment.study import definition

    assert recipe.all("USER") == [definition.USER]
    assert json.loads(recipe.all("VOLUME")[0]) == [definition.SCRATCH]
    assert recipe.env["TMPDIR"] == recipe.env["HOME"] == definition.SCRATCH
    assert recipe.all("EXPOSE") == [" ".join(map(str, PORTS))]


def test_the_dockerfile_runs_what_local_runs(recipe: Recipe) -> None:
    from hippodrome.local.backend.tasks import PYTHON_TRIAL

    command = json.loads(recipe.all("CMD")[0])  # the exec form: python itself gets SIGTERM, not a shell
    assert command == ["python", *(word for word in PYTHON_TRIAL[1:] if word != "-P")]
    assert recipe.env["PYTHONSAFEPATH"] == "1"  # the same as -P
    assert recipe.all("WORKDIR") == [recipe.env["AGENT_DIR"]]


def test_a_stage_tries_the_agent_and_adds_nothing_to_the_image(recipe: Recipe) -> None:
    """BuildKit skips a stage of which nothing is used: https://docs.docker.com/build/building/multi-stage/"""
    _, tried, last = stages()
    assert recipe.all("FROM") == ["${BASE} AS image"]
    assert tried.steps == [  # as the image's user, with its variables
        ("FROM", "image AS tried"),
        ("COPY", "check.json /hippodrome/check.json"),
        ("RUN", '["python", "-m", "hippodrome.trial.check", "/hippodrome/check.json", "60"]'),
    ]
    same = "/hippodrome/requirements/trial.txt"
    assert last.steps == [("FROM", "image"), ("COPY", f"--from=tried {same} {same}")]
    assert ("requirements/trial.txt", same) in recipe.copies, "the file is that of the image"


def test_the_dockerfile_copies_first_what_changes_least(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    sources = [source for source, _ in recipe.copies]
    assert sources == [
        "requirements/trial.txt",
        "requirements/project.txt",
        "hippodrome/",
        "project/",
        "requirements/project.txt",
    ]
    runs = [index for index, (word, _) in enumerate(recipe.steps) if word == "RUN"]
    assert max(runs) < recipe.steps.index(("COPY", "hippodrome/ /hippodrome/hippodrome/"))
    make_bundle(folder).write_folder(tmp_path / "context")
    for source in sources:
        assert (tmp_path / "context" / source).exists()


def test_a_project_without_files_of_its_own_can_be_built(folder: Path, tmp_path: Path) -> None:
    (folder / "agent.py").unlink()
    make_bundle(folder).write_folder(tmp_path / "context")
    assert (tmp_path / "context/project").is_dir()


def test_the_versions_of_the_trial_are_pinned() -> None:
    for line in (ROOT / "requirements/trial.txt").read_text().splitlines():
        assert line.startswith("#") or re.fullmatch(r"[A-Za-z0-9-]+==[0-9.]+", line)


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


def test_the_files_of_the_image_can_play_a_game(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
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
        assert container.process.wait(60) == 0, container.process.communicate()
    finally:
        container.process.kill()
        container.process.communicate()
    answer = json.loads((tmp_path / "store/maze/users/P1/answers/3.json").read_text())
    assert answer["answers"]["episodes"] == 1
    assert container.files() == container.before  # files are written only below /scratch


def test_sigterm_ends_the_server_of_the_image(recipe: Recipe, folder: Path, tmp_path: Path) -> None:
    write_study(folder, agent_DOT_py=grid_agent(None))
    make_bundle(folder).write_folder(tmp_path / "context")
    container = Container(recipe, tmp_path / "context", tmp_path / "root", {**ENV, "STORE": str(tmp_path / "store")})
    try:
        container.port()
        container.process.terminate()
        assert container.process.wait(60) == 0
    finally:
        container.process.kill()
        container.process.communicate()
