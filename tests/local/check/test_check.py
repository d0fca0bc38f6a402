"""`python -m local.check`: every mistake and remark, and nothing about what is fine."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from hippodrome.config import read_project
from local.backend.platform import LocalPlatform
from local.check import agent as agent_check
from local.check import agent_process
from local.check.agent_report import last_line, slowness
from local.check.outside import Outside
from local.check.pace import Pace
from local.check.pages import check_pages
from local.check.project import check_project
from local.publish import publish
from local.watch import Watch
from testing import preloaded
from testing.exploration import sample
from tests.local.conftest import ROOT, Local, write_study

pytestmark = pytest.mark.usefixtures("forked")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_study(tmp_path / "study", start=2)


def page(folder: Path, text: str, name: str = "hello") -> None:
    (folder / "steps" / f"{name}.html").write_text(text)


def config(folder: Path, old: str, new: str) -> None:
    file = folder / "config.yml"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def agent(folder: Path, old: str, new: str) -> None:
    file = folder / "agent.py"
    assert old in file.read_text()
    file.write_text(file.read_text().replace(old, new))


def looked(folder: Path) -> list[str]:
    return [str(problem) for problem in check_project(folder, read_project(folder))]


def tried(folder: Path, seconds: float = 60) -> list[str]:
    return [str(problem) for problem in agent_check.try_agent(folder, read_project(folder), seconds)]


def run(folder: Path) -> tuple[int, list[str]]:
    said = folder.parent / "said.log"
    with said.open("w") as errors:
        done = preloaded.start(
            "local.check",
            [str(folder)],
            cwd=folder.parent,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=errors,
        )
    try:
        output = done.communicate(timeout=60)[0]
    finally:
        done.kill()
    assert "Traceback" not in said.read_text(), said.read_text()
    assert done.returncode is not None
    return done.returncode, output.splitlines()


# --- the command -------------------------------------------------------------------------------------


def test_a_good_study(folder: Path) -> None:
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


def test_everything_at_once(folder: Path) -> None:
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


def test_no_such_folder(tmp_path: Path) -> None:
    assert run(tmp_path / "nowhere") == (1, [f"{tmp_path / 'nowhere'}: there is no such folder", "1 mistake."])


# --- Jinja -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("\n{% if group %}", "2: Jinja cannot read this: Unexpected end of template."),
        ("a\n{% endfi %}", "2: Jinja cannot read this: Encountered unknown tag 'endfi'."),
        ("\n\n{{ group|shout }}", "3: there is no filter shout in Jinja"),
        ("{{ group|uper }}", "1: there is no filter uper in Jinja; did you mean upper?"),
        ("\n{% if answers['1'].a %}\n{{ group|uper }}{% endif %}", "3: there is no filter uper"),
        ("{% if group is evn %}{% endif %}", "1: there is no test evn in Jinja; did you mean even?"),
        ("<title>x\n</title>\n{{ nobody() }}", "3: the page cannot be shown: UndefinedError: 'nobody' is undefined"),
        ("\n{% include 'other.html' %}", "2: include, import and extends do not work: a page is one file"),
        (
            "<style>@media print{#menu{display:none}}</style>{{ group }}",
            "1: Jinja cannot read this: Missing end of comment tag; {# begins",
        ),
        ("{{ 1 // 0 }}", "1: the page cannot be shown: ZeroDivisionError"),
        ("{{ 'x' * 100000000 }}", "1: the page cannot be shown: SecurityError"),
    ],
)
def test_jinja(folder: Path, text: str, said: str) -> None:
    page(folder, text)
    assert any(line.startswith(f"steps/hello.html:{said}") for line in looked(folder)), looked(folder)
    assert any(not problem.remark for problem in check_pages(folder, read_project(folder)))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "{{ completion_cod }}",
            "nothing is shown: there is no value completion_cod; did you mean completion_code?",
        ),
        ("{{ answers['1'].n * 2 }}", "a participant without the answer gets an error page here (UndefinedError: "),
    ],
)
def test_jinja_that_may_be_meant(folder: Path, text: str, said: str) -> None:
    page(folder, text)
    (line,) = looked(folder)
    assert line.startswith(f"steps/hello.html:1: remark: {said}")


def test_jinja_that_is_fine(folder: Path) -> None:
    page(
        folder,
        """{{ answers["9"].x.y }} {{ participant.PROLIFIC_PID }} {{ project.name|upper }} {{ completion_code }}
        {% set n = 3 %}{{ n }} {% for i in range(3) %}<input name="q{{ i }}">{% endfor %} {{ answers["1"].a|tojson }}
        <style>@media print{ #menu{display:none}}</style> {{ group if group is not none else "nobody" }}""",
    )
    assert looked(folder) == []


def test_each_group_is_shown_its_page(folder: Path) -> None:
    (folder / "steps" / "hello.html").unlink()
    page(folder, "{{ 1 // group }}", "hello-0")
    page(folder, "{{ 1 // group }}", "hello-1")
    page(folder, "\n{% if group == 1 %}{{ 1 // 0 }}{% endif %}", "bye")
    lines = looked(folder)
    assert [line.partition(": ")[0] for line in lines] == ["steps/hello-0.html:1", "steps/bye.html:2"]


# --- HTML --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<img src='cta.png'>", "there is no cta.png in steps/; did you mean cat.png?"),
        ("<img src='Cat.png'>", "there is no Cat.png in steps/; did you mean cat.png?"),
        (
            "<img src='pictures/cat.png'>",
            "pictures/cat.png is not found: put the file into steps/ itself and write cat.png",
        ),
        ("<img src='/steps/quick/dog.png'>", "there is no dog.png in steps/"),
        ("<img srcset='cat.png 1x, dog.png 2x'>", "there is no dog.png in steps/"),
        ("<video poster=dog.png></video>", "there is no dog.png in steps/"),
        ("<img src='cat.bmp'>", "cat.bmp is not shown: of files beside the pages only png, "),
        ("<iframe src='bye.html'></iframe>", "<iframe> cannot show a file of the project"),
        ("<p onclick='go()'>", "onclick never runs; use addEventListener in a <script> of the page"),
        ("<a href='javascript:go()'>x</a>", "javascript: never runs; "),
        ("<textarea></textarea>", "this <textarea> has no name"),
        ("<select name=''></select>", "this <select> has no name"),
        ("<p style='background: url(cat.png)'>", "cat.png is not found from a style; write url(/steps/quick/cat.png)"),
        ("<style>p { background: url('cat.png') }</style>", "cat.png is not found from a style; "),
    ],
)
def test_html_remarks(folder: Path, text: str, said: str) -> None:
    (folder / "steps" / "cat.png").touch()
    page(folder, f"{{# a\ncomment #}}\n{text}")
    (line,) = looked(folder)
    assert line.startswith(f"steps/hello.html:3: remark: {said}")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("<input type=File name=x>", "files cannot be sent; take this field out"),
        (
            "<img src='https://other.example/cat.png'>",
            "https://other.example is not in allowedHosts of the config file, so nothing is loaded; "
            "add https://other.example to allowedHosts",
        ),
        ("<script src='//other.example/x.js'></script>", "https://other.example is not in allowedHosts"),
        (
            "<img src='http://media.example/cat.png'>",
            "http://media.example is not in allowedHosts of the config file, so nothing is loaded; write https:// here",
        ),
        ("<link rel=stylesheet href=https://media.example/x.css>", "style sheets of other places are not loaded"),
        ("<embed src=https://media.example/x>", "<embed> is never shown"),
    ],
)
def test_html_mistakes(folder: Path, text: str, said: str) -> None:
    config(folder, "  maxRuntime", "  allowedHosts: [https://media.example]\n  maxRuntime")
    page(folder, f"\n{text}")
    (line,) = looked(folder)
    assert line.startswith(f"steps/hello.html:2: {said}")


def test_html_that_is_fine(folder: Path) -> None:
    config(folder, "  maxRuntime", "  allowedHosts: [https://media.example]\n  maxRuntime")
    (folder / "steps" / "a cat.png").touch()
    (folder / "steps" / "x.js").touch()
    page(
        folder,
        """<img src="a%20cat.png?2#x"><img src="./a cat.png"><img src="/steps/quick/a%20cat.png">
        <img src="https://MEDIA.example/x.png"><img src="https://media.example:443/x"><img src="data:image/png;base64,AA=">
        <img src="{{ project.id }}.png"><a href="https://anywhere.example">x</a><link rel="preconnect" href="https://x.example">
        <iframe src="https://media.example/video"></iframe><script src="x.js"></script>
        <script>if (1 < 2) document.write('<img src="none.png" onclick="x">')</script>
        <input type="submit"><input type=button><button>Go</button><input name="q{{ group }}" value="{{ answers["1"].n }}">
        <!-- <img src="none.png"> --> <style>p { background: url(/steps/quick/x.png), url(data:image/png;base64,AA=) }</style>
        <p one="x" only="y">""",
    )
    assert looked(folder) == []


# --- questions and tags ------------------------------------------------------------------------------


def radio(name: str, *values: str) -> str:
    return "\n".join(f'<label><input type="radio" name="{name}" value="{value}"> {value}</label>' for value in values)


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        (radio("q", "a", "b") + "\n" + radio("q", "a", "b"), 4, "an earlier question has the name q too"),
        (f"<fieldset>{radio('q', 'a', 'b')}</fieldset>\n<fieldset>{radio('q', 'c', 'd')}</fieldset>", 4, "an earlier question has"),
        (f"<table><tr><td>{radio('q', '1', '2')}</tr>\n<tr><td>{radio('q', '3', '4')}</tr></table>", 4, "an earlier question has"),
        ('<input type="radio" name="q" value="a">\n<input type="radio" name="q">', 3, "this choice of q has no value"),
        ("a\n<textarea name=x>\n<p>more", 3, "<textarea> is never closed, so the rest of the page is not shown"),
        ("<script>let a = 1", 2, "<script> is never closed"),
        ("a\n<!-- a comment\n<p>", 3, "this comment is never closed"),
        ("<script>\nconst a = '{{ answers['1'].a }}'\n</script>", 3, "in a <script>, write {{ answers['1'].a|tojson }}"),
        ("<script>var id = {{ participant.PROLIFIC_PID }};</script>", 2, "in a <script>, write {{ participant.PROLIFIC_PID|tojson }}"),
    ],
)  # fmt: skip
def test_questions_and_tags_that_lose_something_are_mistakes(folder: Path, text: str, line: int, said: str) -> None:
    page(folder, f"<h1>Hello</h1>\n{text}")
    found = looked(folder)
    assert any(each.startswith(f"steps/hello.html:{line}: {said}") for each in found), found


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("a\n<div>b", 3, "<div> is never closed; add </div>"),
        ("<b>a\n<i>b</b>", 3, "<i> is never closed"),
        ("a\n</section>", 3, "</section> closes nothing"),
    ],
)
def test_tags_left_open_are_remarks(folder: Path, text: str, line: int, said: str) -> None:
    page(folder, f"<h1>Hello</h1>\n{text}")
    assert [each for each in looked(folder) if each.startswith(f"steps/hello.html:{line}: remark: {said}")]


def test_questions_and_tags_that_are_fine(folder: Path) -> None:
    page(
        folder,
        f"""<h1>Hello<br></h1><p>One<p>Two<ul><li>a<li>b</ul>
        <fieldset>{radio("q", "a", "b")}</fieldset><fieldset>{radio("r", "a", "b")}</fieldset>
        <table><tr><td>{radio("s", "1")}</td></tr><tr><td>{radio("s", "2")}</td></tr><tr><td>{radio("s", "3")}</table>
        {{% if group == 1 %}}{radio("t", "a", "b")}{{% else %}}{radio("t", "a", "b")}{{% endif %}}
        {{% for i in range(2) %}}<div>{radio("u{{ i }}", "a", "b")}</div>{{% endfor %}}
        <svg><path d="M0 0"/><circle r="1"/></svg> <b><i>x</b></i>
        <script>const a = {{{{ answers["1"].a|tojson }}}}, g = {{{{ group }}}}, n = {{{{ (group or 0)|int }}}}; if (a < 1) b = "<div>"</script>""",
    )  # fmt: skip
    assert looked(folder) == []


def test_what_was_answered_before_is_there(folder: Path) -> None:
    page(
        folder,
        '<input type="number" name="age" required><input type="number" name="more"><input type="radio" name="r" value="1">',
    )
    page(
        folder,
        '{% if answers["1"].age|int > 1 %}{{ answers["1"].age * 2 }}{% endif %}{{ answers["2"].score + 1 }}',
        "bye",
    )
    assert looked(folder) == []
    page(folder, '\n{{ answers["1"].r + "x" }}{{ answers["1"].r.strip() }}', "bye")
    (line,) = looked(folder)
    assert line.startswith("steps/bye.html:2: remark: a participant without the answer gets an error page here")
    page(folder, '{{ answers["3"].word.strip() }}', "bye")  # its own answer
    assert "remark: a participant without the answer gets" in looked(folder)[0]


def test_a_page_that_no_step_shows(folder: Path) -> None:
    page(folder, "<p>Hi</p>", "forgotten")
    assert looked(folder) == [
        "steps/forgotten.html: remark: no step shows this page; name it under project.steps, or delete it"
    ]


def test_pages_that_no_step_shows_are_one_remark(folder: Path) -> None:
    for name in ("left", "forgotten"):
        page(folder, "<p>Hi</p>", name)
    assert looked(folder) == [
        "steps/: remark: no step shows these pages; name them under project.steps, or delete them: "
        "forgotten.html, left.html"
    ]


@pytest.mark.parametrize("text", ["<" * 5000, "<!", "<![x", "{{", "<img src='http://[x'>", "\0<p\0>", "<p " * 999])
def test_no_page_makes_it_fail(folder: Path, text: str) -> None:
    page(folder, text)
    looked(folder)


# --- agent.py ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("class Agent:", "class Other:", "agent.py: there is no class Agent"),
        ("class Agent:", "class Agnet:", "agent.py: there is no class Agent; is Agnet meant to be Agent?"),
        ("class Agent:", "class agent:", "agent.py: there is no class Agent; is agent meant to be Agent?"),
        ("def render(self):\n        return self.env", "def rendr(self):\n        return self.env", "agent.py:15: Agent has no render"),
        ("def step(self, action):", "def step(self, a, b, c):", "agent.py:21: step(a, b, c) cannot be called; write step(action) or step(env, action)"),
        ("import numpy", "import no_such_thing; import numpy", "agent.py:1: start(\"none\") fails: ModuleNotFoundError: No module named 'no_such_thing'; install its package: .venv/bin/pip install no_such_thing"),
        ("self.n += 1", "self.n += 'x'", "agent.py:8: step(0) fails: TypeError: unsupported operand"),
        ("return self.env.step(action)", "return 5", "agent.py:21: step() must return "),
        ("np.zeros((16, 16, 3), np.uint8)", "None", "agent.py:23: render() returned nothing; "),
        ("def reset(self, seed=None):", "def reset():", "agent.py:"),
        ("render()\n    def close(self):\n        pass", "render()\n    def close(self):\n        1 / 0", "agent.py:26: remark: close() fails: ZeroDivisionError"),
        ("self.env = Env()", "raise SystemExit(3)", 'agent.py:17: start("none") fails: SystemExit: 3'),
        ("self.env = Env()", "print('Oh!'); import os; os._exit(4)", 'agent.py:16: start("none") ended Python itself (exit status 4)'),
        ("self.env = Env()", "import signal; signal.raise_signal(11)", 'agent.py:16: start("none") ended Python itself (signal SIGSEGV)'),
    ],
)  # fmt: skip
def test_agents_that_fail(folder: Path, old: str, new: str, said: str) -> None:
    agent(folder, old, new)
    (line,) = tried(folder)
    assert line.startswith(said)


def test_callbacks_that_fail_are_mistakes_and_the_game_is_played_all_the_same(folder: Path) -> None:
    source = folder / "agent.py"
    start = len(source.read_text().splitlines())
    source.write_text(
        source.read_text() + "    def on_tick(self, session):\n        return session.observatons\n"
        "    def on_episode_end(self):\n        pass\n"
    )
    raising, uncallable = tried(folder)
    assert raising.startswith(f"agent.py:{start + 2}: on_tick() fails: AttributeError: 'Session' object has no")
    assert uncallable == (
        f"agent.py:{start + 3}: on_episode_end() fails: TypeError: Agent.on_episode_end() takes 1 positional argument "
        "but 2 were given"
    )


def test_a_callback_that_hangs_is_remarked(folder: Path) -> None:
    source = folder / "agent.py"
    start = len(source.read_text().splitlines())
    source.write_text(
        source.read_text() + "    def on_tick(self, session):\n        import time\n        time.sleep(999)\n"
    )
    assert tried(folder) == [
        f"agent.py:{start + 1}: remark: on_tick() takes longer than callbackSeconds (0.5 s); callbacks are skipped "
        "until it has returned"
    ]


def test_callbacks_that_are_fine_are_not_remarked(folder: Path) -> None:
    source = folder / "agent.py"
    source.write_text(
        source.read_text() + "    def on_tick(self, session):\n        session.record('t', session.ticks)\n"
    )
    assert tried(folder) == []


def test_an_agent_that_fails_late_is_seen(folder: Path) -> None:
    agent(folder, "self.n += 1", "self.n += 1; assert self.n != 25, 'late'")
    (line,) = tried(folder)
    assert line.startswith("agent.py:8: step(")
    assert "fails (episode 1, after 24 steps in all): AssertionError: late" in line


def test_an_agent_that_fails_in_one_group_only_is_seen(folder: Path) -> None:
    (folder / "steps" / "hello.html").unlink()
    page(folder, "<p>0", "hello-0")
    page(folder, "<p>1", "hello-1")
    agent(folder, "self.n += 1", "import os; self.n += 1; assert os.environ['GROUP'] != '1', 'never'")
    (line,) = tried(folder)
    assert "group 1): AssertionError: never" in line
    status, lines = run(folder)
    assert status == 1
    assert "  played in group 0: 1 of 1 episodes to the end, 30 steps" in lines


def test_a_game_without_an_end_is_played_for_a_while_and_that_is_said(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    agent(folder, "self.n >= 30", "False")
    monkeypatch.setattr(agent_check, "PLAY_SECONDS", 0.5)
    said: list[str] = []
    assert agent_check.try_agent(folder, read_project(folder), 60, said.append) == []
    assert re.fullmatch(r"played: 0 of 1 episodes to the end, \d+ steps \(its time was over\)", said[0])


def test_a_method_that_is_nearly_a_callback_is_remarked_on(folder: Path) -> None:
    agent(folder, "    def close", "    def on_episode_over(self, session):\n        pass\n\n    def close")
    (line,) = looked(folder)
    assert re.fullmatch(
        r"agent\.py:\d+: remark: on_episode_over is no callback, so it is never called; did you mean on_episode_end\?",
        line,
    )
    agent(
        folder,
        "    def close",
        "    def on_episode_end(self, session):\n        self.on_episode_over(session)\n\n    def close",
    )
    assert looked(folder) == []


@pytest.mark.parametrize("limit", ["maxSteps: 12", "episodeSeconds: 0.2"])
def test_an_episode_ends_at_its_limit(folder: Path, limit: str) -> None:
    agent(folder, "self.n >= 30", "False")
    config(folder, "  maxEpisodes: 1\n", f"  maxEpisodes: 2\n  {limit}\n")
    said: list[str] = []
    assert agent_check.try_agent(folder, read_project(folder), 60, said.append) == []
    assert said == ["played: 2 of 2 episodes to the end, 24 steps"]


@pytest.mark.parametrize(("names", "remark"), [("[noop, left, right]", False), ("[noop]", True)])
def test_more_names_than_actions_is_a_mistake(folder: Path, names: str, remark: bool) -> None:
    config(folder, "actionSpace: [noop, left]", f"actionSpace: {names}")
    config(folder, ", left: true", "")
    agent(folder, "class Env:", "class Space:\n    n = 2\n\nclass Env:\n    action_space = Space()")
    (line,) = tried(folder)
    assert f"has {names.count(',') + 1} names, but the environment has 2 actions" in line
    assert (": remark: " in line) is remark
    assert line.startswith("config.yml:")


@pytest.mark.parametrize(
    ("actions", "dead"),
    [
        ("[noop, left, wright]", True),
        ("[noop, left, RIGHT]", False),
        ("[noop, left, upright]", False),
        ("[noop, left, jump, jumpright]", False),
    ],
)
def test_an_arrow_that_no_action_is_called_after_is_remarked(folder: Path, actions: str, dead: bool) -> None:
    config(folder, "actionSpace: [noop, left]", f"actionSpace: {actions}")
    config(folder, "left: true", "left: true, right: true, down: false")
    remark = "config.yml:14: remark: trial.ui.right: the arrow does nothing: no action is called right"
    assert looked(folder) == ([remark] if dead else [])


@pytest.mark.parametrize(
    ("ui", "count", "remark"),
    [
        ("left: true, right: true", 2, "the arrows left and right are not shown: the environment has 2 actions without "
         "names; name them all, in their order: actionSpace: [left, right]"),
        ("up: true", 3, "the arrow up is not shown: the environment has 3 actions without names; name them all, in "
         "their order: actionSpace: [up, …]"),
        ("left: false", 2, None),
    ],
)  # fmt: skip
def test_arrows_of_actions_without_names_are_remarked(folder: Path, ui: str, count: int, remark: str | None) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "")
    config(folder, "left: true", ui)
    agent(folder, "class Env:", f"class Space:\n    n = {count}\n\nclass Env:\n    action_space = Space()")
    assert tried(folder) == ([] if remark is None else [f"config.yml:13: remark: trial.ui: {remark}"])


@pytest.mark.parametrize("action_space", ["", "  actionSpace: []\n"])
def test_an_arrow_without_an_action_of_the_environment_is_remarked(folder: Path, action_space: str) -> None:
    config(folder, "  actionSpace: [noop, left]\n", action_space)
    config(folder, "left: true", "left: true, right: true")
    agent(folder, "class Env:", "class Env:\n    def get_action_meanings(self):\n        return ['NOOP', 'LEFT']")
    (line,) = tried(folder)
    assert line.endswith("remark: trial.ui.right: the arrow does nothing: no action is called right")


def test_arrows_of_actions_without_names_are_not_remarked_where_ui_is_not(folder: Path) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "")
    config(folder, "  ui: {start: true, pause: true, stop: true, left: true}\n", "")
    agent(folder, "class Env:", "class Space:\n    n = 2\n\nclass Env:\n    action_space = Space()")
    assert tried(folder) == []


def test_arrows_that_are_there_because_ui_is_not_are_not_remarked(folder: Path) -> None:
    config(folder, "  ui: {start: true, pause: true, stop: true, left: true}\n", "")
    assert looked(folder) == []


def test_a_key_without_an_action_of_the_environment_is_remarked(folder: Path) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "  keys:\n    ArrowLeft: left\n    Space: jump\n")
    agent(folder, "class Env:", "class Env:\n    def get_action_meanings(self):\n        return ['NOOP', 'LEFT']")
    (line,) = tried(folder)
    assert line.endswith("the key does nothing: no action is called jump; there are noop, left")


def test_with_keys_the_arrows_of_ui_are_not_remarked(folder: Path) -> None:
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left]\n  keys: {a: left}")
    config(folder, "left: true", "left: true, right: true")
    assert looked(folder) == []


def test_players_whom_no_participant_plays_are_remarked(folder: Path) -> None:
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left]\n  players: {a: human, b: human, c: idle}")
    (line,) = looked(folder)
    assert line.endswith(
        "remark: trial.players: 2 players are human (a, b), and a game has one participant, who plays the first; "
        "write players: 2 under project, or let the others be played by a policy"
    )
    groups = "players: {0: {a: human, b: random}, 1: {a: human, b: human}}"
    config(folder, "players: {a: human, b: human, c: idle}", groups)
    (line,) = looked(folder)
    assert "trial.players.1: 2 players are human" in line


def test_keys_that_act_before_their_combination_are_remarked(folder: Path) -> None:
    keys = "keys: {a: left, b+a: noop, c+d: noop}"
    config(folder, "actionSpace: [noop, left]", f"actionSpace: [noop, left]\n  {keys}")
    assert looked(folder) == []
    config(folder, keys, f"{keys}\n  input: single")
    (line,) = looked(folder)
    assert line.endswith('trial.keys.b+a: with input: single, a does "left" before the other key is down')


def test_fields_of_a_page_that_the_game_page_shows_are_remarked(folder: Path) -> None:
    (folder / "steps" / "rules.html").write_text("<h1>Rules</h1><label>Age <input name='age'></label>")
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left]\n  instructions: rules")
    (line,) = looked(folder)
    assert line == (
        "steps/rules.html: remark: its fields are not sent anywhere, since the game page shows it; ask in a step of its own"
    )
    (folder / "steps" / "rules.html").write_text("<h1>Rules</h1><p>{{ nobody.knows }}</p>")
    assert any("nobody" in line for line in looked(folder))


@pytest.mark.parametrize(
    ("seconds", "slow"),
    [
        ([0.5] * 6, "2 steps a second"),
        ([0.3] * 10, "3.3 steps a second"),
        ([0.13] * 40, None),  # 7.7 of 15
        ([0.5] * 4, None),  # too short to say
        ([9.0, *[0.05] * 50], None),  # one step that has to load something
        ([], None),
    ],
)
def test_what_counts_as_slow(seconds: list[float], slow: str | None) -> None:
    pace = Pace()
    for each in seconds:
        pace.took(each)
    said = slowness(pace, 15)
    assert said == (None if slow is None else f"it plays {slow} here; startingFrameRate is 15")


def test_an_agent_far_slower_than_the_frame_rate_is_remarked(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent(folder, "self.n += 1", "import time; time.sleep(0.3); self.n += 1")
    monkeypatch.setattr(agent_check, "PLAY_SECONDS", 3.0)
    (line,) = tried(folder)
    said = r"config\.yml:11: remark: trial\.startingFrameRate: it plays [\d.]+ steps a second here; .* is 60"
    assert re.fullmatch(said, line)


def with_a_third_name(folder: Path, step: str) -> None:
    """A study with three names, of which the environment has two; it complains of any other."""
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left, right]")
    agent(folder, "class Env:", "class Space:\n    n = 2\n\nclass Env:\n    action_space = Space()")
    agent(folder, "self.n += 1", "self.n += 1; assert action in (0, 1), 'no such action'")
    agent(folder, "return self.env.step(action)", step)


def test_an_agent_may_turn_names_into_actions_of_the_environment(folder: Path) -> None:
    with_a_third_name(folder, "return self.env.step([0, 0, 1][action])")
    assert tried(folder) == []


def test_an_error_is_not_blamed_on_the_names_where_the_agent_turns_them_into_actions(folder: Path) -> None:
    with_a_third_name(folder, "assert action != 2, 'mine'; return self.env.step(0)")
    (line,) = tried(folder)
    assert "step(2) fails" in line
    assert line.endswith("AssertionError: mine")


def test_an_action_that_the_environment_complains_of_is_a_mistake_of_the_names(folder: Path) -> None:
    with_a_third_name(folder, "return self.env.step(action)")
    (line,) = tried(folder)
    assert line.startswith("config.yml:13: trial.actionSpace: has 3 names, but the environment has 2 actions; ")


def test_an_agent_that_hangs(folder: Path) -> None:
    agent(folder, "self.n += 1", "import time; time.sleep(1000)")
    began = time.monotonic()
    assert tried(folder, 2) == ["agent.py:8: step(0) has not come back within 2 s"]
    assert time.monotonic() - began < 10


def test_nothing_that_the_agent_starts_is_left(folder: Path, tmp_path: Path) -> None:
    note = tmp_path / "pid"
    agent(
        folder,
        "self.env = Env()",
        f"import subprocess; open({str(note)!r}, 'w').write(str(subprocess.Popen(['sleep', '99']).pid)); self.env = Env()",
    )
    assert tried(folder) == []
    until = time.monotonic() + 5
    while Path(f"/proc/{note.read_text()}/cmdline").exists() and Path(f"/proc/{note.read_text()}/cmdline").read_bytes():
        assert time.monotonic() < until
        time.sleep(0.05)


def test_a_custom_agent_without_action_space(folder: Path) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "")
    assert tried(folder) == [
        "config.yml:8: trial.actionSpace: missing; list the game's actions, since the environment does not name them"
    ]


def test_a_game_that_does_not_exist(folder: Path) -> None:
    (folder / "agent.py").unlink()
    config(folder, "game: none", "game: CartPoll-v1")
    (line,) = tried(folder)
    assert line.startswith('config.yml:9: trial.game: start("CartPoll-v1") fails: gymnasium.error.NameNotFound: ')


def test_a_game_without_an_agent(folder: Path) -> None:
    (folder / "agent.py").unlink()
    config(folder, "game: none", "game: ALE/Pong-v5")
    said = "config.yml:13: remark: trial.actionSpace: has 2 names, but the environment has 6 actions"
    assert tried(folder) == [said]


def test_an_agent_sees_what_a_server_would_see(folder: Path) -> None:
    config(folder, "  maxEpisodes: 1", "  maxEpisodes: 1\n  options: {level: 7}")
    (folder / "beside.py").write_text("LEVEL = 7")
    lines = """import beside, json, os, threading
        assert json.loads(os.environ["TRIAL"])["options"]["level"] == beside.LEVEL
        assert os.environ["GROUP"] == "" and os.path.exists("config.yml")
        assert threading.current_thread() is not threading.main_thread()
        self.env = Env()"""
    agent(folder, "self.env = Env()", lines)
    assert tried(folder) == []


# --- agents that are started before their participant is known


def warm(folder: Path, *, groups: bool = True) -> None:
    config(folder, "  maxRuntime: 5", "  maxRuntime: 5\n  warmServers: 2")
    if groups:
        page(folder, "<h1>Hello</h1>", "hello-0")
        (folder / "steps" / "hello.html").rename(folder / "steps" / "hello-1.html")


EARLY = "is not known here: with warmServers the agent starts before its participant comes; read it in reset()"


READS = ("os.environ.get('GROUP')", "os.getenv('GROUP')", "'GROUP' in os.environ", "environ.get('GROUP', '0')")


@pytest.mark.explores
@pytest.mark.parametrize(("reads", "at"), sample([(reads, at) for reads in READS for at in (1, 18)], 3))
def test_a_group_that_is_read_too_early(folder: Path, reads: str, at: int) -> None:
    warm(folder)
    if at == 1:
        agent(folder, "import numpy as np", f"import os; from os import environ; import numpy as np; x = {reads}")
    else:
        agent(folder, "self.env = Env()", f"import os; from os import environ\n        x = {reads}; self.env = Env()")
    assert tried(folder) == [f"agent.py:{at}: remark: GROUP {EARLY}"]


def test_a_group_that_is_demanded_too_early_is_a_mistake_with_its_reason(folder: Path) -> None:
    warm(folder, groups=False)  # an ordinary server has an empty one
    agent(folder, "self.env = Env()", "import os; self.group = os.environ['GROUP']")
    remark, mistake = tried(folder)
    assert remark == f"agent.py:17: remark: GROUP {EARLY}"
    assert mistake == "agent.py:17: start(\"none\") fails: KeyError: 'GROUP'"


def test_a_participant_who_is_asked_for_too_early(folder: Path) -> None:
    warm(folder, groups=False)
    (folder / "beside.py").write_text("import os\nPERSON = os.environ.get('USER_ID')\nGROUP = os.environ.get('GROUP')")
    agent(folder, "import numpy", "import beside; import numpy")
    assert tried(folder) == [f"beside.py:2: remark: USER_ID {EARLY}"]


def test_a_group_that_is_read_at_the_reset_is_there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GROUP", "of this shell")
    monkeypatch.setenv("USER_ID", "of this shell")
    warm(folder)
    agent(folder, "self.env = Env()", "import os; dict(os.environ); os.environ.copy(); self.env = Env()")
    agent(
        folder,
        "return self.env.reset(seed=seed)",
        "import os; assert (os.environ['GROUP'] in '01', os.environ['USER_ID']) == (True, 'check'); return self.env.reset()",
    )
    assert tried(folder) == []


def test_what_libraries_look_up_is_not_the_projects(folder: Path) -> None:
    warm(folder)
    library = folder / ".venv" / "lib" / "site-packages"
    library.mkdir(parents=True)
    (library / "somebodys.py").write_text("import os\nx = os.environ.get('GROUP')")
    agent(folder, "import numpy", f"import sys; sys.path.append({str(library)!r}); import somebodys; import numpy")
    assert tried(folder) == []


def test_without_warm_servers_a_group_may_be_read_at_any_time(folder: Path) -> None:
    page(folder, "<h1>Hello</h1>", "hello-0")
    (folder / "steps" / "hello.html").rename(folder / "steps" / "hello-1.html")
    agent(folder, "self.env = Env()", "import os; assert os.environ['GROUP'] in '01'; self.env = Env()")
    assert tried(folder) == []


def test_a_mistake_in_a_file_beside_the_agent(folder: Path) -> None:
    (folder / "beside.py").write_text("\nx = (")
    agent(folder, "import numpy", "import beside; import numpy")
    assert tried(folder) == ["beside.py:2: start(\"none\") fails: SyntaxError: '(' was never closed"]


def test_without_a_game_the_agent_does_not_matter(folder: Path) -> None:
    config(folder, "2: game, 3: bye", "2: bye")
    config(folder, "  events: {startServerStep: 2, stopServerStep: 3}\n", "")
    (folder / "agent.py").write_text("(")
    status, lines = run(folder)
    assert status == 0
    assert len(lines) == 1


@pytest.mark.parametrize("source", [b"x = '\xff'", b"\0", b"(", b"  x", b"return"])
def test_an_agent_that_python_cannot_read(folder: Path, source: bytes) -> None:
    (folder / "agent.py").write_bytes(source)
    (line,) = looked(folder)
    assert line.startswith("agent.py")
    assert "Python cannot read this" in line


# --- the code that recruiters ask for -----------------------------------------------------------------

NO_CODE = (
    "remark: this last page shows no code for the recruiting site: write {{ completion_code }}, or a link back to it"
)


def of_codes(folder: Path, name: str = "end") -> list[str]:
    return [line.removeprefix(f"steps/{name}.html: ") for line in looked(folder) if "completion_code" in line]


@pytest.fixture
def on_aws(folder: Path) -> Path:
    config(folder, "  maxRuntime: 5", "  maxRuntime: 5\n  useAWS: true\n  awsSetup: {cpu: 1, memory: 2}")
    return folder


def test_a_last_page_without_a_code_is_remarked(on_aws: Path) -> None:
    assert of_codes(on_aws) == [NO_CODE]
    page(on_aws, "{{ completion_code }}", "hello")
    assert of_codes(on_aws) == [NO_CODE], "those who do not finish see the earlier pages, too"


@pytest.mark.parametrize(
    "text",
    [
        "{# {{ completion_code }} #}",
        "<p>Your completion_code</p>",
        "{% raw %}{{ completion_code }}{% endraw %}",
        "<!-- <a href='https://recruiter.example/complete?cc=C1'>back</a> -->",
        "<a href='more.html'>more</a>",
    ],
)
def test_what_shows_no_code(on_aws: Path, text: str) -> None:
    page(on_aws, text, "end")
    assert of_codes(on_aws) == [NO_CODE]


@pytest.mark.parametrize(
    "text",
    [
        "<p>Your code: {{ completion_code }}</p>",
        "{% if group %}{{ completion_code|lower }}{% endif %}",
        "<p><a href='https://recruiter.example/submissions/complete?cc=YOURCODE'>Return</a></p>",
        '<a href="https://recruiter.example/?id={{ participant.userId }}">Return</a>',
    ],
)
def test_a_code_or_a_link_back_is_enough(on_aws: Path, text: str) -> None:
    page(on_aws, text, "end")
    assert of_codes(on_aws) == []


def test_each_groups_last_page_needs_one(on_aws: Path) -> None:
    (on_aws / "steps" / "end.html").unlink()
    page(on_aws, "{{ completion_code }}", "end-0")
    page(on_aws, "<h1>Goodbye</h1>", "end-1")
    assert of_codes(on_aws, "end-1") == [NO_CODE]


def test_a_study_on_one_machine_needs_no_code(folder: Path) -> None:
    assert of_codes(folder) == []


# --- while the study is held ------------------------------------------------------------------------


def test_what_a_held_study_is_told(folder: Path, tmp_path: Path) -> None:
    from lambdas import installed

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
    assert told("agent.py", change=lambda: agent(folder, "class Agent:", "class Agent")) == [
        "agent.py:15: Python cannot read this: expected ':'"
    ]
    platform.close()


def test_make_run_says_why_a_page_is_broken(local: Callable[..., Local]) -> None:
    here = local(start=2)
    page(here.folder, "<h1>Hello</h1>\n{{ nobody( }}")
    here.run()
    here.told(r"steps/hello\.html:2: Jinja cannot read this: unexpected '}'")
    page(here.folder, "<h1>Hello</h1>")
    here.told("No mistakes are left")


def test_a_server_for_every_opened_link_is_remarked_and_no_mistake(folder: Path) -> None:
    config(folder, "startServerStep: 2", "startServerStep: 1")
    (line,) = looked(folder)
    assert line.startswith("config.yml:7: remark: project.events.startServerStep: every opened link starts a server")
    assert run(folder)[0] == 0


def test_how_far_an_agent_came_is_read_from_the_last_whole_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent_process, "REPORT_BYTES", 1_000)
    report = tmp_path / "report"
    progress = agent_process._Progress(report, tmp_path, Outside(None))
    sizes = []
    for step in range(50):
        progress.steps = step
        assert progress.call("step", lambda: None)
        told = last_line(report.read_text())
        assert (told["call"], told["steps"]) == ("step", step)
        sizes.append(report.stat().st_size)
    assert 1_000 < max(sizes) < 2_000, "it begins anew"
    with report.open("a") as file:
        file.write('{"call": "rend')
    assert last_line(report.read_text())["steps"] == 49


def test_an_agent_that_closes_all_files_is_reported_all_the_same(folder: Path) -> None:
    agent(folder, "class Agent:", "import os\nclass Agent:")
    agent(
        folder,
        "    def step(self, action",
        "    def step(self, action_: int):\n        os.closerange(3, 999)\n        raise ValueError('in vain')\n    def other(self, action",
    )
    (said,) = tried(folder)
    assert "in vain" in said
