"""Where `hippodrome data` finds the data of a study: on this machine, or on AWS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from tests.deployment.installation import CommandResult, Installed
from tests.export.data_world import crowd, into_folder
from tests.export.place import Place, rows

LOCAL = """project:
  id: maze
  live: true
  steps: {1: consent, finalStep: end}
"""


def project_folder(tmp: Path, config: str = LOCAL) -> Path:
    """Make a project's folder beside the folder in which the command runs."""
    folder = tmp / "my-study"
    folder.mkdir()
    (folder / "config.yml").write_text(config)
    return folder


def told(capsys: Any, *arguments: str) -> CommandResult:
    capsys.readouterr()
    code = main(["data", *arguments])
    printed = capsys.readouterr()
    return CommandResult(code, printed.out, printed.err)


def test_a_study_of_this_machine_is_converted_into_its_folder(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    folder = project_folder(tmp_path)
    crowd(into_folder(folder / "data"), tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    ran = told(capsys, "my-study/")
    assert (ran.code, "On this machine, in my-study/data" in ran.err) == (Exit.DONE, True), ran.err
    assert "--aws" not in ran.err
    assert len(rows(folder / "data-maze" / "answers.csv")) == 2
    monkeypatch.chdir(folder)
    assert told(capsys).code == Exit.DONE
    assert told(capsys, "maze").code == Exit.DONE
    assert sorted(path.name for path in folder.iterdir()) == ["config.yml", "data", "data-maze"]


def test_a_local_study_without_participants_says_so(tmp_path: Path, capsys: Any) -> None:
    folder = project_folder(tmp_path)
    ran = told(capsys, f"{folder}/")
    assert ran.code == Exit.FAILED
    assert "no folder" in ran.err
    assert "--aws" in ran.err
    assert "region" not in ran.err
    (folder / "data-try" / "try-20260101-000000").mkdir(parents=True)
    assert "try-20260101-000000" in told(capsys, f"{folder}/").err


def test_a_folder_of_rehearsals_is_refused_with_the_folder_to_name(tmp_path: Path, capsys: Any) -> None:
    tried = tmp_path / "data-try"
    to = ("--to", str(tmp_path / "out"))
    for name in ("try-20260101-000000", "try-20260102-000000"):
        crowd(into_folder(tried / name), tmp_path, 1)
        ran = told(capsys, "maze", "--from", str(tried), *to)
        assert ran.code == Exit.FAILED
        assert f"Name that: --from {tried / name}." in " ".join(ran.err.split())
    assert "try-20260101-000000 has data of maze." in ran.err
    assert told(capsys, "maze", "--from", str(tried / name), *to).code == Exit.DONE


def test_without_a_data_folder_the_data_of_a_study_that_may_be_on_aws_are_there(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 2)
    folder = project_folder(tmp_path, LOCAL + "  awsSetup: {cpu: 1, memory: 2}\n")
    monkeypatch.chdir(tmp_path)
    ran = world.run(capsys, "data", "my-study/")
    assert (ran.code, "On AWS, since there is no folder my-study/data on this machine" in ran.err) == (Exit.DONE, True)
    assert len(rows(folder / "data-maze" / "answers.csv")) == 2


MAY_BE_ON_AWS = ["  awsSetup: {cpu: 1, memory: 2}\n", "  useAWS: true\n"]


@pytest.mark.parametrize("config", MAY_BE_ON_AWS)
@pytest.mark.parametrize("command", [["data"], ["erase", "ann"]])
def test_data_that_may_be_in_two_places_are_not_guessed(
    tmp_path: Path, capsys: Any, monkeypatch: Any, config: str, command: list[str]
) -> None:
    folder = project_folder(tmp_path, LOCAL + config)
    crowd(into_folder(folder / "data"), tmp_path, 1)
    monkeypatch.chdir(tmp_path)
    assert main([*command, "my-study/"]) == Exit.MISUSE
    said = capsys.readouterr().err
    typed = "hippodrome data" if command == ["data"] else "hippodrome erase USER_ID"
    assert f"  {typed} my-study/ --from my-study/data\n  {typed} my-study/ --aws\n" in said
    monkeypatch.chdir(folder)
    assert main(command) == Exit.MISUSE
    assert f"  {typed} --from data\n  {typed} --aws\n" in capsys.readouterr().err
    assert not (folder / "data-maze").exists()


def test_a_person_is_asked_for_one_of_two_places(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 3)
    folder = project_folder(tmp_path, LOCAL + MAY_BE_ON_AWS[0])
    crowd(into_folder(folder / "data"), tmp_path, 1)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    for answer, participants in (("h", 1), ("AWS", 3)):
        monkeypatch.setattr("builtins.input", lambda answer=answer: answer)
        ran = world.run(capsys, "data", f"{folder}/", "--to", str(tmp_path / answer))
        assert ran.code == Exit.DONE, ran.err
        assert f"  here: on this machine, in {folder}/data\n  aws: on AWS\nhere or aws? " in ran.err
        assert len(rows(tmp_path / answer / "answers.csv")) == participants
    monkeypatch.setattr("builtins.input", lambda: "yes")
    assert told(capsys, f"{folder}/").code == Exit.DECLINED


def test_options_say_where_the_data_are_whatever_the_config_says(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 3)
    folder = project_folder(tmp_path)
    crowd(into_folder(folder / "data"), tmp_path, 1)
    crowd(into_folder(folder / "data-try" / "try-1"), tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    assert world.run(capsys, "data", "my-study/", "--to", "on-aws", "--aws").code == Exit.DONE
    assert len(rows(tmp_path / "on-aws" / "answers.csv")) == 3
    assert told(capsys, "my-study/").code == Exit.DONE
    assert told(capsys, "my-study/", "--from", "my-study/data-try/try-1").code == Exit.DONE
    assert len(rows(folder / "data-maze-try-1" / "answers.csv")) == 2  # beside the study's own data, not among them
    assert len(rows(folder / "data-maze" / "answers.csv")) == 1
    ran = told(capsys, "my-study/", "--to", "my-study/data-maze", "--from", "my-study/data-try/try-1")
    assert (ran.code, "was filled from the folder" in ran.err) == (Exit.FAILED, True)
    assert told(capsys, "maze", "--aws", "--from", "data").code == Exit.MISUSE


def test_data_of_this_machine_in_the_way_of_those_on_aws_are_left_and_another_folder_is_named(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 3)
    folder = project_folder(tmp_path)
    crowd(into_folder(folder / "data"), tmp_path, 1)
    monkeypatch.chdir(folder)
    assert told(capsys).code == Exit.DONE
    ran = world.run(capsys, "data", "--aws")
    assert ran.code == Exit.FAILED
    assert "data-maze was filled from the folder of this machine" in ran.err
    assert "Name another folder, such as --to data-maze-2" in ran.err
    assert world.run(capsys, "data", "--aws", "--to", "data-maze-2").code == Exit.DONE
    assert len(rows(folder / "data-maze-2" / "answers.csv")) == 3
    assert len(rows(folder / "data-maze" / "answers.csv")) == 1


def test_a_folder_and_a_bucket_at_once(place: Place) -> None:
    assert "name two places" in place.run("--bucket", "hippodrome-bucket").err
