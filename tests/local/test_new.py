"""`make new`: a study of one's own from an example, or a sentence that says why not."""

from __future__ import annotations

import errno
import os
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from hippodrome.console.problem import Problem
from hippodrome.control.config import read_project
from hippodrome.local import new

ROOT = Path(__file__).resolve().parents[2]
TOP = "ms-pacman"


def make_new(*variables: str) -> subprocess.CompletedProcess[str]:
    """`make new` as people type it, without a look at what is installed."""
    env = {name: value for name, value in os.environ.items() if name not in ("MAKEFLAGS", "MAKELEVEL", "PROJECT")}
    command = ["make", "-o", ".venv/local", "new", *variables]
    return subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=False)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A clone with one example, in which someone has played and tried things."""
    root = tmp_path / "clone"
    example = root / "examples" / "maze"
    for file in (
        *("steps/hello.html", "steps/.draft.html", "policies/partner.onnx", "agent.py", "requirements.txt"),
        *("data/maze/users/ada/participant.json", "data-try/try-1/x.json", "__pycache__/agent.pyc", "policies/a.pyc"),
        *(".hippodrome/x", ".env"),
    ):
        (example / file).parent.mkdir(parents=True, exist_ok=True)
        (example / file).write_text(file)
    text = "# A maze.\nproject:\n  id: maze  # unique\n  name: In a maze\n  steps: {1: hello}\n"
    (example / "config.yml").write_text(text)
    return root


def test_make_new_makes_a_study_and_says_what_to_do_next(tmp_path: Path) -> None:
    folder = tmp_path / "new" / "My study"
    done = make_new(f"PROJECT={folder}", f"TEMPLATE={TOP}")
    assert done.returncode == 0, done.stderr
    assert f"Made {folder} from {TOP}; its project id is My-study." in done.stdout
    for command in ("run", "check", "try"):
        assert f"hippodrome {command} '{folder}'" in done.stdout
    assert read_project(folder).project.id == "My-study"
    assert sorted(path.name for path in folder.iterdir()) == ["agent.py", "config.yml", "steps"]


def test_without_arguments_it_lists_the_templates() -> None:
    done = make_new()
    assert done.returncode == 0
    assert done.stdout.splitlines()[0] == f"Name a folder and a template: hippodrome new ../my-study {TOP}"
    assert re.search(rf"^  {TOP} +Learning to play Ms\. Pac-Man$", done.stdout, re.MULTILINE)


@pytest.mark.parametrize(
    ("variables", "why"), [((), "No template is named."), (("TEMPLATE=pacman",), "There is no template pacman.")]
)
def test_without_a_template_that_it_knows_it_lists_them(variables: tuple[str, ...], why: str, tmp_path: Path) -> None:
    done = make_new(f"PROJECT={tmp_path / 'x'}", *variables)
    assert done.returncode != 0
    assert f"✗ {why}" in done.stderr.splitlines()
    assert re.search(rf"^  {TOP} +Learning to play Ms\. Pac-Man$", done.stderr, re.MULTILINE)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("variables", [(), ("PROJECT=.",)])
def test_without_a_folder_it_asks_for_one(variables: tuple[str, ...]) -> None:
    done = make_new(*variables, f"TEMPLATE={TOP}")
    assert done.returncode != 0
    assert "✗ No folder is named for the new study." in done.stderr.splitlines()
    assert f"→ Name one: hippodrome new ../my-study {TOP}" in done.stderr.splitlines()


@pytest.mark.parametrize("name", new.templates())
def test_every_template_makes_a_study_without_mistakes(tmp_path: Path, name: str) -> None:
    template = new.templates()[name]
    new.make_study(template, tmp_path / "mine")
    made, shown = read_project(tmp_path / "mine"), read_project(template.folder)
    assert made.project.id == "mine"
    assert (made.trial, made.steps[0].page) == (shown.trial, shown.steps[0].page)


def test_templates_are_the_examples_and_the_study_at_the_top() -> None:
    examples = {path.parent.name for path in (ROOT / "examples").glob("*/config.yml")}
    assert set(new.templates()) == {TOP, *examples}


def test_data_caches_and_hidden_files_are_not_copied(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    assert new.make_study(new.templates(root)["maze"], folder) == "mine"
    made = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert made == {"config.yml", "agent.py", "requirements.txt", "steps/hello.html", "policies/partner.onnx"}


def test_only_the_id_changes_in_the_file(root: Path, tmp_path: Path) -> None:
    new.make_study(new.templates(root)["maze"], tmp_path / "mine")
    before = (root / "examples" / "maze" / "config.yml").read_text()
    assert (tmp_path / "mine" / "config.yml").read_text() == before.replace("id: maze", "id: mine")


def test_commands_and_links_of_the_copy_are_adapted(root: Path, tmp_path: Path) -> None:
    (root / "docs").mkdir()
    (root / "docs" / "objects.md").write_text("# Objects")
    readme = "hippodrome run examples/maze, or (examples/maze).\n`python examples/maze/draw.py` tests/examples/maze [objects](../../docs/objects.md#types)"
    (root / "examples" / "maze" / "README.md").write_text(readme)
    folder = tmp_path / "deep" / "mine"
    new.make_study(new.templates(root)["maze"], folder)
    command, rest = (folder / "README.md").read_text().split("\n")
    assert command == f"hippodrome run {folder}, or ({folder})."
    assert rest == f"`python {folder}/draw.py` tests/examples/maze [objects](../../clone/docs/objects.md#types)"


@pytest.mark.parametrize("name", sorted(set(new.templates()) - {TOP}))
def test_the_links_of_each_copy_lead_somewhere(tmp_path: Path, name: str) -> None:
    new.make_study(new.templates()[name], tmp_path / "mine")
    text = (tmp_path / "mine" / "README.md").read_text()
    links = re.findall(r"\]\((?!http)([^)#]+)", text)
    assert [link for link in links if not (tmp_path / "mine" / link).exists()] == []
    assert f"hippodrome run {tmp_path}/mine" in text


def test_a_study_can_be_made_in_an_empty_folder(root: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    new.make_study(new.templates(root)["maze"], tmp_path / "mine")
    assert (tmp_path / "mine" / "agent.py").is_file()


def test_a_folder_that_holds_something_stays_as_it_is(root: Path, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "thesis.tex").write_text("years of work")
    with pytest.raises(Problem, match="is not empty, and nothing in it was changed"):
        new.make_study(new.templates(root)["maze"], folder)
    assert [path.name for path in folder.iterdir()] == ["thesis.tex"]


def test_a_file_in_the_place_of_the_folder_is_refused(root: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("a file")
    with pytest.raises(Problem, match="is a file"):
        new.make_study(new.templates(root)["maze"], tmp_path / "mine")
    assert (tmp_path / "mine").read_text() == "a file"


def test_a_study_is_not_made_inside_its_template(root: Path) -> None:
    with pytest.raises(Problem, match="lies in the template itself"):
        new.make_study(new.templates(root)["maze"], root / "examples" / "maze" / "mine")
    assert not (root / "examples" / "maze" / "mine").exists()


@pytest.mark.parametrize("name", ["???", "ssl", "_"])
def test_a_name_that_makes_no_id_is_refused(root: Path, tmp_path: Path, name: str) -> None:
    with pytest.raises(Problem, match="No project id can be made"):
        new.make_study(new.templates(root)["maze"], tmp_path / name)
    assert not (tmp_path / name).exists()


def test_a_place_where_nothing_can_be_written_is_reported_in_a_sentence(root: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(Problem, match="cannot be written: Not a directory"):
        new.make_study(new.templates(root)["maze"], tmp_path / "file" / "mine")


def test_a_disk_that_fills_up_is_reported_with_the_first_file_that_did_not_fit(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def copyfile(source: str, target: str, **_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), source, None, target)

    monkeypatch.setattr(shutil, "copyfile", copyfile)
    with pytest.raises(Problem) as told:
        new.make_study(new.templates(root)["maze"], tmp_path / "mine")
    assert re.fullmatch(rf"{tmp_path}/mine/\S+ cannot be written: No space left on device\.", str(told.value))


def test_a_folder_with_an_unreadable_config_is_no_template(root: Path) -> None:
    (root / "examples" / "maze" / "config.yml").write_text("project:\n\tid: maze\n")
    shutil.copytree(root / "examples" / "maze", root / "examples" / "empty")
    assert new.templates(root) == {}
