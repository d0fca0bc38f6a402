"""Where `deploy data` finds the data of a study: on this machine, or on AWS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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


def test_a_study_of_this_machine_is_converted_without_a_word_about_aws(
    tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    folder = project_folder(tmp_path)
    crowd(into_folder(folder / "data"), tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    ran = told(capsys, "--project", "my-study/")
    assert (ran.code, f"data folder {Path('my-study/data')} of this machine" in ran.err) == (Exit.DONE, True), ran.err
    assert len(rows(tmp_path / "data-maze" / "answers.csv")) == 2
    monkeypatch.chdir(folder)
    assert told(capsys).code == Exit.DONE
    assert len(rows(folder / "data-maze" / "answers.csv")) == 2
    assert told(capsys, "--project", "maze").code == Exit.DONE


def test_a_local_study_without_participants_says_so(tmp_path: Path, capsys: Any) -> None:
    folder = project_folder(tmp_path)
    ran = told(capsys, "--project", f"{folder}/")
    assert ran.code == Exit.FAILED
    assert "no folder" in ran.err
    assert "--aws" in ran.err
    assert "region" not in ran.err
    (folder / "data-try" / "try-20260101-000000").mkdir(parents=True)
    assert "try-20260101-000000" in told(capsys, "--project", f"{folder}/").err


def test_a_folder_of_rehearsals_is_refused_with_the_folder_to_name(tmp_path: Path, capsys: Any) -> None:
    tried = tmp_path / "data-try"
    for name in ("try-20260101-000000", "try-20260102-000000"):
        crowd(into_folder(tried / name), tmp_path, 1)
        ran = told(capsys, str(tmp_path / "out"), "--project", "maze", "--from", str(tried))
        assert ran.code == Exit.FAILED
        assert f"--from {tried / name} (with make: DATA={tried / name})" in " ".join(ran.err.split())
    assert "try-20260101-000000 has data of maze." in ran.err
    assert told(capsys, str(tmp_path / "out"), "--project", "maze", "--from", str(tried / name)).code == Exit.DONE


def test_a_study_that_leaves_open_where_it_runs_and_has_no_data_on_a_machine_without_aws(
    tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    for name in ("AWS_REGION", "AWS_DEFAULT_REGION", "AWS_PROFILE", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    folder = project_folder(tmp_path, LOCAL + "  awsSetup: {cpu: 1, memory: 2}\n")
    ran = told(capsys, "--project", f"{folder}/")
    assert ran.code == Exit.FAILED
    first, _, advice = ran.err.partition("→")
    assert "There are no data of maze on this machine" in first
    assert "region" not in first
    assert "`make run` makes it" in advice
    assert "If they are on AWS: No AWS region is set." in " ".join(advice.split())
    assert "no data" not in told(capsys, "--project", f"{folder}/", "--aws").err  # who asks for AWS hears of AWS


def test_a_study_on_aws_is_fetched_from_there_and_data_here_are_named(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 2)
    folder = project_folder(tmp_path, LOCAL + "  useAWS: true\n")
    crowd(into_folder(folder / "data"), tmp_path, 1)
    monkeypatch.chdir(tmp_path)
    ran = world.run(capsys, "data", "--project", "my-study/")
    assert ran.code == Exit.DONE, ran.err
    assert "From AWS" in ran.err
    assert f"--from {Path('my-study/data')}" in ran.err
    assert len(rows(tmp_path / "data-maze" / "answers.csv")) == 2


def test_a_study_that_leaves_open_where_it_runs_has_its_data_where_somebody_has_taken_part(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 2)
    folder = project_folder(tmp_path, LOCAL + "  awsSetup: {cpu: 1, memory: 2}\n")
    monkeypatch.chdir(tmp_path)
    assert world.run(capsys, "data", "from-aws", "--project", "my-study/").code == Exit.DONE
    assert len(rows(tmp_path / "from-aws" / "answers.csv")) == 2
    crowd(into_folder(folder / "data"), tmp_path, 1)
    ran = world.run(capsys, "data", "from-here", "--project", "my-study/")
    assert "From AWS: --aws" in ran.err
    assert len(rows(tmp_path / "from-here" / "answers.csv")) == 1


def test_options_say_where_the_data_are_whatever_the_config_says(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 3)
    folder = project_folder(tmp_path)
    crowd(into_folder(folder / "data"), tmp_path, 1)
    crowd(into_folder(folder / "data-try" / "try-1"), tmp_path, 2)
    monkeypatch.chdir(tmp_path)
    assert world.run(capsys, "data", "on-aws", "--project", "my-study/", "--aws").code == Exit.DONE
    assert len(rows(tmp_path / "on-aws" / "answers.csv")) == 3
    assert told(capsys, "--project", "my-study/").code == Exit.DONE
    assert told(capsys, "--project", "my-study/", "--from", "my-study/data-try/try-1").code == Exit.DONE
    assert len(rows(tmp_path / "data-maze-try-1" / "answers.csv")) == 2  # beside the study's own data, not among them
    assert len(rows(tmp_path / "data-maze" / "answers.csv")) == 1
    ran = told(capsys, "data-maze", "--project", "my-study/", "--from", "my-study/data-try/try-1")
    assert (ran.code, "was filled from the folder" in ran.err) == (Exit.FAILED, True)
    assert told(capsys, "--project", "maze", "--aws", "--from", "data").code == Exit.FAILED


def test_data_of_this_machine_in_the_way_of_those_on_aws_are_left_and_another_folder_is_named(
    world: Installed, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    crowd(world.put, tmp_path, 3)
    crowd(into_folder(project_folder(tmp_path) / "data"), tmp_path, 1)
    monkeypatch.chdir(tmp_path)
    ran = told(capsys, "--project", "my-study/")
    assert "From AWS: --aws (with make: ARGS=--aws)" in ran.err
    ran = world.run(capsys, "data", "--project", "my-study/", "--aws")
    assert ran.code == Exit.FAILED
    assert "data-maze was filled from the folder of this machine" in ran.err
    assert 'with make: ARGS="--aws data-maze-2"' in ran.err
    assert world.run(capsys, "data", "--project", "my-study/", "--aws", "data-maze-2").code == Exit.DONE
    assert len(rows(tmp_path / "data-maze-2" / "answers.csv")) == 3
    assert len(rows(tmp_path / "data-maze" / "answers.csv")) == 1


def test_a_folder_and_a_bucket_at_once(place: Place) -> None:
    assert "name two places" in place.run("--bucket", "hippodrome-bucket").err
