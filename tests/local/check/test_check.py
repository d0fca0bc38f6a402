"""`hippodrome check`: it reports every mistake and remark, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from hippodrome.local.backend.platform import LocalPlatform
from hippodrome.local.publish import publish
from hippodrome.local.watch import Watch
from tests.local.check.checking import agent, config, looked, page, run, tried
from tests.local.conftest import ROOT, Local

# --- the command -------------------------------------------------------------------------------------


def test_a_good_study_has_no_findings(folder: Path) -> None:
    assert run(folder) == (
        0,
        [
            "trying agent.py …",
            "  played: 1 of 1 episodes to the end, 30 steps",
            "No mistakes: 4 steps, step 2 is the game (none), a server from step 2 to step 3, at most 5 minutes",
        ],
    )


def test_the_example_is_free_of_remarks() -> None:
    assert looked(ROOT) == []
    assert tried(ROOT) == []


def test_all_mistakes_are_reported_at_once_by_check(folder: Path) -> None:
    config(folder, "maxRuntime: 5", "maxRuntime: 0")
    page(folder, "<h1>Hello</h1>\n{{ nobody( }}\n<img src=missing.png>")
    agent(folder, "class Agent:", "class Agent")
    status, lines = run(folder)
    assert status == 1
    assert lines == [
        "config.yml:5: project.maxRuntime: must be a whole number from 1 to 1440, not 0",
        "steps/hello.html:2: Jinja cannot read this: unexpected '}', expected ')'",
        "steps/hello.html:3: remark: there is no missing.png in steps/",
        "agent.py:15: Python cannot read this: expected ':'",
        "3 mistakes and 1 remark.",
    ]


def test_a_game_without_agent_py_is_tried_although_a_page_has_a_mistake(folder: Path) -> None:
    (folder / "agent.py").unlink()
    page(folder, "{{ nobody( }}")
    _, (mistake, trying, failure, counts) = run(folder)
    assert mistake.startswith("steps/hello.html:1: Jinja cannot read this")
    assert trying == "trying none …"
    assert failure.startswith('config.yml:9: trial.game: start("none") fails')
    assert counts == "2 mistakes."


def test_remarks_alone_are_no_failure(folder: Path) -> None:
    page(folder, "<input>")
    status, lines = run(folder)
    assert status == 0
    assert lines[0] == "steps/hello.html:1: remark: this <input> has no name, so what is entered there is never sent"
    assert lines[-1].startswith("No mistakes, 1 remark: 4 steps")


def test_a_failing_game_is_a_mistake(folder: Path) -> None:
    agent(folder, "self.env = Env()", "self.env = Envy()")
    status, lines = run(folder)
    assert status == 1
    assert lines == [
        "trying agent.py …",
        "agent.py:17: start(\"none\") fails: NameError: name 'Envy' is not defined",
        "1 mistake.",
    ]


# --- while the study runs -----------------------------------------------------------------------------


def test_a_running_study_reports_mistakes_in_changed_files(folder: Path, tmp_path: Path) -> None:
    from hippodrome.functions import installed

    platform = LocalPlatform(tmp_path / "data", tmp_path / "state", handlers={})
    installed.use(platform)
    said: list[str] = []
    page(folder, "{{ x( }}\n<input>", "bye")
    watch = Watch(
        folder,
        publish(folder, platform.documents),
        lambda: publish(folder, platform.documents),
        lambda _: None,
        said.append,
    )

    def told(*names: str, change: Callable[[], None] = lambda: None) -> list[str]:
        said.clear()
        change()
        watch._known = watch._look()
        watch._changed(list(names))
        return said[len(names) :]

    watch._check()
    jinja = "steps/bye.html:1: Jinja cannot read this: unexpected '}', expected ')'"
    unnamed = "steps/bye.html:2: remark: this <input> has no name, so what is entered there is never sent"
    assert said == [jinja, unnamed]
    assert told("steps/hello.html") == []
    assert told("steps/bye.html") == [jinja, unnamed]
    assert told("steps/bye.html", change=lambda: page(folder, "\n<input>", "bye")) == [unnamed, "No mistakes are left"]
    good = (folder / "config.yml").read_text()
    assert told("config.yml", change=lambda: config(folder, "maxRuntime: 5", "maxRuntime: 0")) == [
        "The study goes on as it was, because of this:",
        "  config.yml:5: project.maxRuntime: must be a whole number from 1 to 1440, not 0",
    ]
    assert told("config.yml", change=lambda: (folder / "config.yml").write_text(good) and None) == [
        "The project is fine again, and the study goes on as it says now"
    ]
    assert told("config.yml") == []
    told("agent.py", change=lambda: agent(folder, "class Agent:", "class Agent"))
    assert said == [
        "agent.py:15: Python cannot read this: expected ':'; servers that start from now on fail until it is mended"
    ]
    platform.close()


def test_make_run_says_why_a_page_is_broken(local: Callable[..., Local]) -> None:
    here = local(start=2)
    page(here.folder, "<h1>Hello</h1>\n{{ nobody( }}")
    here.run()
    here.wait_for_text(r"steps/hello\.html:2: Jinja cannot read this: unexpected '}'")
    page(here.folder, "<h1>Hello</h1>")
    here.wait_for_text("No mistakes are left")


def test_a_server_for_every_opened_link_is_remarked_and_no_mistake(folder: Path) -> None:
    config(folder, "startServerStep: 2", "startServerStep: 1")
    (line,) = looked(folder)
    assert line.startswith("config.yml:7: remark: project.events.startServerStep: every opened link starts a server")
    assert run(folder)[0] == 0


def test_an_agent_that_closes_all_files_is_still_reported(folder: Path) -> None:
    agent(folder, "class Agent:", "import os\nclass Agent:")
    agent(
        folder,
        "    def step(self, action",
        "    def step(self, action_: int):\n        os.closerange(3, 999)\n        raise ValueError('in vain')\n    def other(self, action",
    )
    (said,) = tried(folder)
    assert "in vain" in said
