"""The command `hippodrome`: its help, its names, and how it ends."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from hippodrome.cli import COMMANDS, GROUPS, main
from hippodrome.console import program
from hippodrome.console.program import as_typed

ROOT = Path(__file__).resolve().parent.parent
NARROW = {"COLUMNS": "80", "TERMINAL_WIDTH": "80"}


def test_help_lists_every_command_in_its_group_and_fits_a_terminal(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in NARROW.items():
        monkeypatch.setenv(name, value)
    assert main(["--help"]) == 0
    shown = capsys.readouterr().out
    for heading, commands in GROUPS.items():
        part = shown.partition(f"{heading}:\n")[2].partition("\n\n")[0]
        assert [line.split()[0] for line in part.splitlines()] == list(commands)
    assert max(map(len, shown.splitlines())) <= 80


def test_a_word_that_is_no_choice_is_refused_with_the_choices(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["secret", "my-study"]) == 2
    assert "Invalid value for 'action': 'my-study' is not one of 'set', 'list', 'remove'." in capsys.readouterr().err


def test_without_a_command_the_help_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    assert "On this machine:" in capsys.readouterr().out


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert capsys.readouterr().out.startswith(f"Usage: hippodrome {command} ")


def test_a_mistyped_command_is_refused_with_the_right_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["chek"]) == 2
    assert "No such command 'chek'. Did you mean 'check'?" in capsys.readouterr().err


def test_help_and_completion_import_no_command() -> None:
    """Else each key of Tab would take seconds, and a Python without the extra `aws` could not list its commands."""
    program = "import sys, hippodrome.cli; hippodrome.cli.main(['--help']); print([n for n in sys.modules if n.startswith(('boto', 'hippodrome.local', 'hippodrome.deployment'))])"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def completions(words: str) -> list[str]:
    """Return what bash offers after these words."""
    env = {"_HIPPODROME_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split(" ")) - 1)}
    done = subprocess.run(
        [sys.executable, "-m", "hippodrome"], cwd=ROOT, env=env, capture_output=True, text=True, check=False
    )
    return done.stdout.split()


def test_commands_and_options_are_completed() -> None:
    assert completions("hippodrome de") == ["deploy", "destroy"]
    assert "--fresh" in completions("hippodrome run --f")


def test_advice_names_the_program_as_it_can_be_typed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = tmp_path / ".venv" / "bin" / "hippodrome"
    ours.parent.mkdir(parents=True)
    monkeypatch.setattr("sys.executable", str(ours.with_name("python")))
    monkeypatch.setenv("PATH", "/nowhere")
    monkeypatch.chdir(tmp_path)
    advice = "Run `hippodrome data maze`.\n  hippodrome run a\nThe stack hippodrome stays, and ../hippodrome run too."
    assert as_typed(advice) == advice  # it was not installed as a program: nothing better is known
    ours.touch()
    ours.chmod(0o755)
    assert as_typed(advice).splitlines()[:2] == [
        "Run `.venv/bin/hippodrome data maze`.",
        "  .venv/bin/hippodrome run a",
    ]
    assert as_typed(advice).splitlines()[2] == advice.splitlines()[2]
    monkeypatch.setenv("PATH", str(ours.parent))
    assert as_typed(advice) == advice


def test_the_program_and_the_advice_know_the_same_commands() -> None:
    assert set(program.COMMANDS) == set(COMMANDS)


def test_python_m_deploy_is_the_same_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "deploy", "stop", "--help"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout.startswith("Usage: hippodrome stop ")


@pytest.mark.parametrize("command", ["check", "run", "try"])
def test_a_folder_without_a_study_is_refused_and_a_mistyped_one_not_made(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([command, "my-stduy"]) == 1
    assert "✗ There is no study in my-stduy: there is no such folder." in capsys.readouterr().err
    assert main([command]) == 1
    said = capsys.readouterr()
    assert (said.out, said.err.splitlines()[0]) == ("", "✗ There is no study in this folder: it has no config.yml.")
    assert not list(tmp_path.iterdir())
    for folder in ("clone/App", "clone/steps"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "clone" / "config.yml").touch()
    assert main([command, "clone/App"]) == 1
    assert f"→ Name the folder {tmp_path / 'clone'}, which has it." in capsys.readouterr().err.splitlines()
