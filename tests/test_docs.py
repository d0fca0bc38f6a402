"""The examples, links, files and messages in the documentation are right."""

from __future__ import annotations

import gzip
import json
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from hippodrome.cli import COMMANDS, load
from tests.test_first_hour import says

ROOT = Path(__file__).resolve().parent.parent
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]


def code(page: str, language: str) -> list[str]:
    text = (ROOT / page).read_text()
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_leads_somewhere(page: Path) -> None:
    for target, heading in re.findall(r"\]\(([^)#]*)(?:#([^)]*))?\)", page.read_text()):
        there = page.parent / target if target else page
        assert target.startswith("http") or there.exists(), target
        assert not heading or heading in headings(there), f"{target}#{heading}"


def headings(page: Path) -> list[str]:
    """Return what links to a page's headings say, as GitHub makes them."""
    titles = re.findall(r"^#+ (.*)", re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL), re.MULTILINE)
    return [re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in titles]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_make_target_exists(page: Path) -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for named in re.findall(r"(?:`|^)make ([a-z]+)", page.read_text(), re.MULTILINE):
        assert named in targets


SOURCES = {
    file.relative_to(ROOT).as_posix()
    for top in ROOT.iterdir()
    if (top.name == ".github" or not top.name.startswith(".")) and top.name not in ("data", "data-try", "shots")
    for file in (top, *(top.rglob("*") if top.is_dir() else ()))
}
OF_A_STUDY = re.compile(r"steps/|(forget|protocol)\.py|App/|src/hippogym|updateProject\.py")
"""Paths that a reader makes, or has from HIPPO Gym."""


def files_named(text: str) -> set[str]:
    """Return what is in backticks and looks like a file or folder of this repository."""
    sentences = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    named = {name.partition("::")[0] for name in re.findall(r"`([\w./-]+(?:::\w+)?)`", sentences)}
    folders = {path.partition("/")[0] for path in SOURCES if "/" in path}
    return {
        name.rstrip("/")
        for name in named
        if not OF_A_STUDY.match(name)
        and (re.search(r"\w\.(py|toml|yml)$", name) or re.match(rf"({'|'.join(folders)})/", name))
    }


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_file_that_is_named_exists(page: Path) -> None:
    """By its path from the root, or by the end of its path where the sentence says in which folder it is."""
    assert {
        name for name in files_named(page.read_text()) if not any(f"/{path}".endswith(f"/{name}") for path in SOURCES)
    } == set()


def test_a_file_that_has_moved_is_noticed() -> None:
    text = "`hippodrome/gone.py`, `gone.py`, `docs/config.md`, `servers/dns.py`, `infra/test_gone.py::test_it`, `tests/gone/`"
    named = files_named(text)
    assert {name for name in named if "gone" in name} == {
        "hippodrome/gone.py",
        "gone.py",
        "infra/test_gone.py",
        "tests/gone",
    }
    assert {"docs/config.md", "servers/dns.py"} <= named


def test_the_tables_of_failures_quote_messages_of_the_program() -> None:
    quoted = [
        (page.name, message)
        for page in PAGES
        for table in re.findall(
            r"^\| it says \|.*?\n\|-.*?\n(.*?)(?:\n\n|\Z)", page.read_text(), re.DOTALL | re.MULTILINE
        )
        for message in re.findall(r"^\| (.+?)(?: \(`make \w+`\))? \|", table, re.MULTILINE)
        if page.name != "first-hour.md"  # tests/test_first_hour.py
    ]
    assert len(quoted) > 20
    assert [each for each in quoted if not says(each[1])] == []


def test_the_table_of_answers_is_made_as_documented(tmp_path: Path) -> None:
    for user, answers in {
        "ada": {"1": {"consent": "yes"}, "2": {"age": "33"}},
        "bob": {"1": {"consent": "no"}},
    }.items():
        folder = tmp_path / "data" / "ms-pacman" / "users" / user / "answers"
        folder.mkdir(parents=True)
        for step, given in answers.items():
            (folder / f"{step}.json").write_text(json.dumps({"step": step, "answers": given}))
    (program,) = [block for block in code("docs/data.md", "python") if "csv" in block]
    done = subprocess.run([sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["userId,1.consent,2.age", "ada,yes,33", "bob,no,"]


def test_a_recording_is_read_as_documented(tmp_path: Path) -> None:
    lines = [{"kind": "header"}, {"kind": "reset"}, {"kind": "step", "reward": 10.0}, {"kind": "step", "reward": 5.0}]
    with gzip.open(tmp_path / "3-episode-0001.jsonl.gz", "wt") as file:
        file.writelines(json.dumps(line) + "\n" for line in lines)
    (program,) = [block for block in code("docs/data.md", "python") if "gzip" in block]
    done = subprocess.run(
        [sys.executable, "-c", f"{program}\nprint(score)"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == "15.0\n"


def test_a_recording_is_read_as_hippos_pickles_were(tmp_path: Path) -> None:
    import numpy as np

    from hippodrome.trial.recordings import recording

    picture = np.arange(6, dtype=np.uint8).reshape(2, 3)
    line = {"kind": "step", "reward": 1.0, "terminated": False, "truncated": True, "info": {"lives": 3}}
    more = {"extra": {"q": [1.5]}, "observation": recording.observation(picture)}
    with gzip.open(tmp_path / "2-episode-0001.jsonl.gz", "wt") as file:
        file.writelines(json.dumps(each) + "\n" for each in ({"kind": "header"}, line | more, {"kind": "end"}))
    (program,) = [block for block in code("docs/hippo.md", "python") if "gzip" in block]
    said = 'print([[entry[key] for key in ("reward", "done", "info", "q")] + [entry["observation"].tolist()] for entry in entries])'
    done = subprocess.run(
        [sys.executable, "-c", f"{program}\n{said}"], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout == f"{[[1.0, True, {'lives': 3}, [1.5], picture.tolist()]]}\n"


@pytest.mark.parametrize("number", [0, 2])
def test_the_agents_shown_keep_the_contract(tmp_path: Path, number: int) -> None:
    from hippodrome.trial.agent.agent import AgentAdapter
    from hippodrome.trial.agent.joint import start

    (tmp_path / "agent.py").write_text(code("docs/agent.md", "python")[number])
    names = ("noop", "up", "right", "down", "left")
    player = AgentAdapter(tmp_path, "ALE/MsPacman-v5" if number == 0 else "mine", None if number == 0 else names)
    if number == 0:
        import ale_py
        import gymnasium

        gymnasium.register_envs(ale_py)
    start(player)
    player.reset(1)
    for action in range(5):
        outcome = player.step(action)
        assert player.render().ndim == 3
    assert number == 0 or outcome.action is None  # the fifth step is the participant's
    player.close()


def test_the_agent_shown_with_several_players_keeps_the_contract(tmp_path: Path) -> None:
    import types

    from hippodrome.trial.agent.agent import AgentAdapter
    from hippodrome.trial.agent.joint import JointAdapter, start
    from hippodrome.trial.policies.places import load

    agent, partner = code("docs/players.md", "python")
    (tmp_path / "agent.py").write_text(agent)
    adapter = start(AgentAdapter(tmp_path, "mine", ("noop", "up", "down")))
    assert isinstance(adapter, JointAdapter)
    module = types.ModuleType("agent")
    exec(partner, vars(module))
    policy = load("agent:Partner", tmp_path, module, 3)
    now, _ = adapter.reset(1)
    policy.reset(1)
    steps = 0
    while not now.over:
        taken = policy.act(now.observations["right"], now.infos.get("right", {}), None)
        now, steps = adapter.step({"left": 2, "right": taken}), steps + 1
        assert now.rewards == {"left": 2.0, "right": 1.0}
    assert (steps, adapter.pictures().shape) == (100, (90, 160, 3))  # type: ignore[union-attr]


def test_the_agent_shown_for_games_without_an_idle_action_passes_the_check(tmp_path: Path) -> None:
    from hippodrome.control.config import read_project, remarks
    from hippodrome.local.check.agent import try_agent

    trial = code("docs/agent.md", "yaml")[0]
    (tmp_path / "agent.py").write_text(code("docs/agent.md", "python")[1])
    (tmp_path / "steps").mkdir()
    (tmp_path / "steps" / "end.html").write_text("<h1>The end</h1>")
    (tmp_path / "config.yml").write_text(f"project: {{id: pole, steps: {{1: game, finalStep: end}}}}\n{trial}")
    config = read_project(tmp_path)
    assert remarks.without_a_key(config) is None
    assert try_agent(tmp_path, config) == []


def shown_commands(text: str) -> list[tuple[str, list[str]]]:
    """Return each command `hippodrome …` that a text shows in backticks or on a line of its own, with its options."""
    lines = re.findall(r"`hippodrome ([^`\n]+)`|^(?: {4}|\$ |)hippodrome ([a-z][^\n|>]*)", text, re.MULTILINE)
    words = [(quoted or line).split("#")[0].split() for quoted, line in lines]
    return [(name, re.findall(r"(?<!\S)--[a-z-]+", " ".join(rest))) for name, *rest in words]


COMMANDS_SHOWN = [
    *PAGES,
    *sorted((ROOT / "examples").glob("*/README.md")),
    *sorted((ROOT / "examples").glob("*/config.yml")),
    *sorted((ROOT / "hippodrome").rglob("*.py")),
    *sorted((ROOT / "infra").glob("*.yml")),
]


def test_every_command_that_is_shown_exists_with_its_options() -> None:
    wrong, seen = [], set()
    for page in COMMANDS_SHOWN:
        for name, options in shown_commands(page.read_text()):
            if name.startswith("-") or name in (
                "COMMAND",
                "…",
                "{command}",
                "in",
            ):  # "hippodrome in eu-west-1": a stack
                continue
            seen.add(name)
            if name not in COMMANDS:
                wrong.append(f"{page.name}: hippodrome {name}")
                continue
            known = {option for part in load(name).params for option in (*part.opts, *part.secondary_opts)}
            wrong += [
                f"{page.name}: hippodrome {name} {option}" for option in options if option not in known | {"--help"}
            ]
    assert wrong == []
    assert len(seen) > 12


def test_the_site_has_every_page_for_some_reader() -> None:
    """Or `make docs` fails: name a new page in READERS."""
    readers = runpy.run_path(str(ROOT / "docs" / "site" / "conf.py"))["READERS"]
    pages = {page.relative_to(ROOT).with_suffix("").as_posix() for page in PAGES} - {"README", "docs/README"}
    assert pages <= {page for group in readers.values() for page in group}
