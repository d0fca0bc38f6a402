"""Which files of a project go into its image."""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from hippodrome.console.problem import Problem
from hippodrome.deployment.study.image import files
from hippodrome.deployment.study.image.bundle import make_bundle
from hippodrome.deployment.study.image.files import Ignore, project_files
from tests.deployment.registering import write_study

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize("app", ["App", "src/hippogym_app"])
def test_of_a_clone_of_hippo_gym_the_files_beside_the_agent_are_in_the_image(folder: Path, app: str) -> None:
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
def test_recordings_and_keys_of_a_clone_stay_out_even_if_its_agent_is_elsewhere(folder: Path, app: str) -> None:
    for name in ("Trials/episode_1_user_P1", "privkey.pem", "fullchain.pem", ".env", "data/map.txt"):
        (folder / app / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / app / name).write_text(name)
    assert set(project_files(folder)) == {f"{app}/data/map.txt", "agent.py"}


@pytest.mark.parametrize("link", ["App", "src"])
def test_a_link_to_a_folder_elsewhere_is_refused(folder: Path, tmp_path: Path, link: str) -> None:
    (folder / "agent.py").unlink()
    elsewhere = tmp_path / "elsewhere"
    place = elsewhere if link == "App" else elsewhere / "hippogym_app"
    place.mkdir(parents=True)
    for name in ("agent.py", "diary.txt"):
        (place / name).write_text(name)
    (folder / link).symlink_to(elsewhere)
    with pytest.raises(Problem, match="is a link out of the project folder"):
        project_files(folder)


def test_hidden_generated_and_unrelated_files_stay_out(folder: Path) -> None:
    write_study(
        folder,
        maps__one_DOT_txt="1",
        maps__steps__two_DOT_txt="2",
        maps__data__three_DOT_txt="3",
        data__maze__users__ada__answers__1_DOT_json="{}",
        **{"data-try__try-1__maze__users__bot__answers__1_DOT_json": "{}"},
        **{
            "data-maze__answers_DOT_csv": "",
            "data-maze-try-1__answers_DOT_csv": "",
            "erased-20261121T101112Z_DOT_json": "{}",
        },
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


def test_a_dockerignore_cannot_add_hidden_files(folder: Path) -> None:
    write_study(folder, _DOT_env="secret", _DOT_dockerignore="!.env\n!config.yml\n")
    assert list(project_files(folder)) == ["agent.py"]


def test_patterns_have_the_meaning_that_docker_gives_them() -> None:
    oracle = pytest.importorskip("docker.utils.build").PatternMatcher
    chance = random.Random(7)
    names = ["a", "ab", "b.py", "c", "d.txt"]
    pieces = ["a", "a*", "*.py", "?", "c", "*", "[ab]b", "d.txt", "ab"]  # docker's own package handles `**` wrongly
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
def test_each_pattern_matches_the_right_files(pattern: str, yes: list[str], no: list[str]) -> None:
    ignored = Ignore([pattern])
    assert [name for name in yes if not ignored(name)] == []
    assert [name for name in no if ignored(name)] == []


def test_links_within_the_folder_become_files(folder: Path) -> None:
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


def test_special_files_are_refused(folder: Path) -> None:
    os.mkfifo(folder / "pipe")
    with pytest.raises(Problem, match=r"pipe is not a file"):
        project_files(folder)


def test_too_many_or_too_large_files_are_refused_naming_the_largest(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "LIMIT_BYTES", 5000)
    write_study(folder, a__model_DOT_bin="x" * 4000, notes_DOT_txt="y" * 3000)
    with pytest.raises(Problem, match="more than") as caught:
        project_files(folder)
    assert "a/model.bin" in caught.value.details[0]
    assert ".dockerignore" in caught.value.advice
    monkeypatch.setattr(files, "LIMIT_FILES", 2)
    with pytest.raises(Problem, match="more than 2 files"):
        project_files(folder)


def test_the_image_of_the_example_holds_only_its_agent() -> None:
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
def test_requirements_that_an_image_cannot_install_are_refused(folder: Path, line: str, said: str) -> None:
    write_study(folder, requirements_DOT_txt=f"numpy  # fine\n\n# ./comment\n{line}\n")
    with pytest.raises(Problem, match=rf"requirements\.txt:4: .*({said})"):
        make_bundle(folder)


@pytest.mark.parametrize(
    "line", ["numpy==2.4.6", "torch>=2,<3 ; python_version > '3'", "a @ https://example.org/a.zip", "a.b[c]"]
)
def test_other_requirements_go_into_the_bundle(folder: Path, line: str) -> None:
    write_study(folder, requirements_DOT_txt=line)
    assert make_bundle(folder).entries["requirements/project.txt"] == line.encode()
