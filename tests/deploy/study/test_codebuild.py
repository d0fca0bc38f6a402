"""Images that CodeBuild builds."""

from __future__ import annotations

import json
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from console.problem import Exit
from deploy.study.image.follow import advice
from tests.deploy.registering import LOG_GROUP, Town, fake_docker, folder, machine, town
from trial import check

__all__ = ["folder", "machine", "town"]


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
        monkeypatch.setenv("PATH", str(town.docker))
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
