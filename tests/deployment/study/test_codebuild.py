"""Images that CodeBuild builds."""

from __future__ import annotations

import json
import zipfile
from importlib.metadata import version
from pathlib import Path

import pytest
import yaml

from hippodrome.console.problem import Exit
from hippodrome.deployment.study.image.follow import advice
from hippodrome.trial import check
from tests.deployment.registering import LOG_GROUP, Register, RegisterWorld, fake_docker


def test_a_build_gets_its_variables_and_its_log_is_shown(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    ran = register(code=Exit.DONE)
    (build,) = register_world.builds
    (tag,) = register_world.image_tags()
    assert build.env == {
        "IMAGE": f"{register_world.repository}:{tag}",
        "REGISTRY": register_world.repository.partition("/")[0],
    }, "a variable without a value may be refused, so there is no CACHE_FROM"
    assert build.asked["sourceLocationOverride"] == f"{register_world.env['BUCKET']}/_builds/{tag}.zip"
    assert yaml.safe_load(build.asked["buildspecOverride"])["version"] == 0.2
    assert "#12 pushing layers done" in ran.err
    (tmp := folder.parent / "b.zip").write_bytes(register_world.get(f"_builds/{tag}.zip"))
    with zipfile.ZipFile(tmp) as archive:
        assert "project/agent.py" in archive.namelist()
        assert json.loads(archive.read("check.json")) == {"game": "ALE/MsPacman-v5"}
        assert "project/config.yml" not in archive.namelist()


def test_a_build_uses_the_layers_of_the_projects_last_image(register_world: RegisterWorld, register: Register) -> None:
    register_world.put_image("maze-aaaaaaaaaaaa")
    register_world.put_image("maze-two-bbbbbbbbbbbb")
    register()
    assert register_world.builds[0].env["CACHE_FROM"] == f"{register_world.repository}:maze-aaaaaaaaaaaa"


def test_a_first_build_uses_the_layers_of_another_project(register_world: RegisterWorld, register: Register) -> None:
    register_world.put_image("other-aaaaaaaaaaaa")
    register()
    assert register_world.builds[0].env["CACHE_FROM"] == f"{register_world.repository}:other-aaaaaaaaaaaa"


def test_a_failed_build_reports_its_cause_and_nothing_is_registered(
    register_world: RegisterWorld, register: Register
) -> None:
    register_world.outcome = "FAILED"
    register_world.log = [
        "#9 3.3 \x1b[31mERROR: No matching distribution found for nosuchthing==9\x1b[0m\x07",
        "\x1b]0;title\x07",
    ]
    ran = register(code=Exit.FAILED)
    problem = ran.err[ran.err.index("✗") :]
    assert "#9 3.3 ERROR: No matching distribution found for nosuchthing==9" in problem
    assert "requirements.txt asks for nosuchthing==9" in problem
    assert "exit status 1" in problem
    assert "\x1b" not in ran.err
    assert "\x07" not in ran.err
    assert register_world.project() is None
    assert register_world.revisions() == []
    register_world.outcome = "SUCCEEDED"
    register(code=Exit.DONE)
    assert len(register_world.builds) == 2
    assert register_world.made.count("s3:PutObject") == 4  # three pages and a bundle, each once


BUILDKIT = [  # BuildKit prints the output of a failed step when it comes, and again at the end
    '#17 [tried 2/2] RUN ["python", "-m", "hippodrome.trial.check", "/hippodrome/check.json", "60"]',
    "#17 2.113 {line}",
    '#17 ERROR: process "python -m hippodrome.trial.check /hippodrome/check.json 60" did not complete successfully: exit code: 1',
    "------",
    " > [tried 2/2] RUN [...]:",
    "2.113 {line}",
    "------",
    'ERROR: failed to solve: process "python -m hippodrome.trial.check" did not complete successfully: exit code: 1',
]


@pytest.mark.parametrize(
    ("module", "package"), [("psutil", f"psutil=={version('psutil')}"), ("nosuch", "the package that brings nosuch")]
)
@pytest.mark.parametrize("on_aws", [True, False])
def test_a_missing_package_is_reported_in_a_sentence_with_advice(
    register_world: RegisterWorld,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    package: str,
    on_aws: bool,
    register: Register,
) -> None:
    what = f"agent.py:3: ModuleNotFoundError: No module named '{module}'"
    line = f"{check.LACKS}{what}{check.REMEDY}write {check.PACKAGE}{module} into requirements.txt beside agent.py"
    log = [told.format(line=line) for told in BUILDKIT]
    register_world.outcome, register_world.log = "FAILED", log
    if not on_aws:
        register_world.docker = fake_docker(tmp_path / "bin", build=1, says="\n".join(log))
        monkeypatch.setenv("PATH", str(register_world.docker))
    ran = register(code=Exit.FAILED)
    told = " ".join(ran.err[ran.err.index("✗") :].split())
    assert f"The image could not be built: {what}" in told
    assert told.endswith(f"Write {package} into requirements.txt beside agent.py; then run the same command again.")
    assert "ERROR" not in told, "the sentence is all"
    assert register_world.project() is None


@pytest.mark.parametrize(
    ("outcome", "said"),
    [("STOPPED", "build was stopped"), ("TIMED_OUT", "took too long"), ("FAULT", "could not be built")],
)
def test_builds_that_stop_or_time_out_are_reported(
    register_world: RegisterWorld, outcome: str, said: str, register: Register
) -> None:
    register_world.outcome = outcome
    ran = register(code=Exit.FAILED)
    assert said in ran.err
    assert register_world.project() is None


def test_a_build_that_leaves_no_image_is_no_success(register_world: RegisterWorld, register: Register) -> None:
    """A push that was cut off leaves layers without a manifest, which are no image."""
    register_world.push = False
    ran = register(code=Exit.FAILED)
    assert "not in the repository" in ran.err
    assert register_world.project() is None
    register_world.push = True
    register(code=Exit.DONE)


def test_ctrl_c_leaves_the_build_running_and_the_next_run_joins_it(
    register_world: RegisterWorld, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    register_world.looks = 3

    def pressed(_: float) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("hippodrome.deployment.study.image.codebuild.time.sleep", pressed)
        ran = register()
    assert ran.code == Exit.INTERRUPTED
    assert "goes on at AWS" in ran.err
    assert "Traceback" not in ran.err
    ran = register(code=Exit.DONE)
    assert "joining" in ran.err
    assert len(register_world.builds) == 1


def test_the_first_of_two_builds_of_the_same_image_counts(
    register_world: RegisterWorld, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    """A tag is used once: the second push is refused, and the image of the first is the wanted one."""
    register_world.looks, register_world.outcome = 2, "FAILED"
    register_world.log = [
        "ERROR: tag invalid: The image tag already exists and cannot be overwritten because it is immutable"
    ]
    monkeypatch.setattr(
        "hippodrome.deployment.study.image.codebuild.time.sleep",
        lambda _: register_world.put_image(register_world.builds[0].env["IMAGE"].rpartition(":")[2]),
    )
    ran = register(code=Exit.DONE)
    assert "meanwhile" in ran.err
    assert register_world.project() is not None


def test_another_content_is_another_build(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    register_world.looks = 10**6
    register_world.interrupt = 30
    register()
    assert len(register_world.builds) == 1
    register_world.interrupt, register_world.looks = None, 1
    (folder / "agent.py").write_text("class Agent:\n    x = 1\n")
    ran = register()
    assert "joining" not in ran.err
    assert len(register_world.builds) == 2


def test_an_account_that_may_not_build_is_reported(register_world: RegisterWorld, register: Register) -> None:
    register_world.fail(
        "codebuild:StartBuild", "AccountLimitExceededException", "Cannot have more than 0 builds in queue"
    )
    ran = register(code=Exit.FAILED)
    assert "may not run another build now" in ran.err
    assert "quota" in ran.err


def test_a_build_log_that_may_not_be_read_is_reported(register_world: RegisterWorld, register: Register) -> None:
    register_world.fail("logs:GetLogEvents", "AccessDeniedException", "no")
    ran = register(code=Exit.FAILED)
    assert "may not get log events" in ran.err
    assert register_world.client("logs").describe_log_groups(logGroupNamePrefix=LOG_GROUP)["logGroups"]


def test_rebuild_makes_another_image_that_stays(register_world: RegisterWorld, register: Register) -> None:
    for _ in range(2):
        register(code=Exit.DONE)
    first = register_world.project().task_definition
    register("--rebuild", code=Exit.DONE)
    plain, anew = register_world.image_tags()
    assert anew == f"{plain}.2"
    assert "CACHE_FROM" not in register_world.builds[1].env
    assert register_world.project().task_definition != first
    newest = register_world.project().task_definition
    register(code=Exit.DONE)
    assert register_world.project().task_definition == newest  # later runs keep the newer image
    assert len(register_world.builds) == 2


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
def test_known_failures_of_builds_have_advice(log: str, said: str) -> None:
    assert said in advice(log)
