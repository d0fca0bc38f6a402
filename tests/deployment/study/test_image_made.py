"""What `register` does with an image that is made, or not: by assembling, or by a Dockerfile."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import pytest

from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.study.image.follow import advice
from hippodrome.trial import check
from tests.deployment.registering import Register, RegisterWorld, fake_docker


def test_an_image_that_cannot_be_made_leaves_nothing_registered(
    register_world: RegisterWorld, register: Register
) -> None:
    register_world.fails = Problem("numpy==9 has no wheel.", "Choose another.")
    ran = register(code=Exit.FAILED)
    assert "numpy==9 has no wheel." in ran.err
    assert "→ Choose another." in ran.err
    assert register_world.project() is None
    assert register_world.revisions() == []
    register_world.fails = None
    register(code=Exit.DONE)
    assert len(register_world.builds) == 2
    assert register_world.made.count("s3:PutObject") == 3, "three pages, each once"


def test_an_image_that_does_not_arrive_is_no_success(register_world: RegisterWorld, register: Register) -> None:
    """A push that was cut off leaves layers without a manifest, which are no image."""
    register_world.push = False
    ran = register(code=Exit.FAILED)
    assert "not in the repository" in ran.err
    assert register_world.project() is None
    register_world.push = True
    register(code=Exit.DONE)


def test_the_first_of_two_makers_of_the_same_image_counts(register_world: RegisterWorld, register: Register) -> None:
    """A tag is used once: the second push is refused, and the image of the first is the wanted one."""
    put = register_world.put_image

    def second(tag: str) -> None:
        put(tag)
        raise Problem("ECR refused a request for hippodrome (HTTP 400).")

    register_world.put_image = second
    ran = register(code=Exit.DONE)
    assert "meanwhile" in ran.err
    assert register_world.project() is not None


def test_rebuild_makes_another_image_that_stays(register_world: RegisterWorld, register: Register) -> None:
    for _ in range(2):
        register(code=Exit.DONE)
    first = register_world.project().task_definition
    register("--rebuild", code=Exit.DONE)
    plain, anew = register_world.image_tags()
    assert anew == f"{plain}.2"
    assert [order.fresh for order in register_world.builds] == [False, True]
    assert register_world.project().task_definition != first
    newest = register_world.project().task_definition
    register(code=Exit.DONE)
    assert register_world.project().task_definition == newest  # later runs keep the newer image
    assert len(register_world.builds) == 2


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
def test_a_missing_package_is_reported_in_a_sentence_with_advice(
    register_world: RegisterWorld,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    module: str,
    package: str,
    register: Register,
) -> None:
    what = f"agent.py:3: ModuleNotFoundError: No module named '{module}'"
    line = f"{check.LACKS}{what}{check.REMEDY}write {check.PACKAGE}{module} into requirements.txt beside agent.py"
    log = "\n".join(told.format(line=line) for told in BUILDKIT)
    register_world.docker = fake_docker(tmp_path / "bin", build=1, says=log)
    monkeypatch.setenv("PATH", str(register_world.docker))
    ran = register("--docker", code=Exit.FAILED)
    told = " ".join(ran.err[ran.err.index("✗") :].split())
    assert f"The image could not be built: {what}" in told
    assert told.endswith(f"Write {package} into requirements.txt beside agent.py; then run the same command again.")
    assert "ERROR" not in told, "the sentence is all"
    assert register_world.project() is None


def test_what_a_failed_build_says_cannot_steer_the_terminal(
    register_world: RegisterWorld, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    said = "#9 3.3 \x1b[31mERROR: No matching distribution found for nosuchthing==9\x1b[0m\x07\n\x1b]0;title\x07"
    register_world.docker = fake_docker(tmp_path / "bin", build=1, says=said)
    monkeypatch.setenv("PATH", str(register_world.docker))
    ran = register("--docker", code=Exit.FAILED)
    problem = ran.err[ran.err.index("✗") :]
    assert "#9 3.3 ERROR: No matching distribution found for nosuchthing==9" in problem
    assert "requirements.txt asks for nosuchthing==9" in problem
    assert "\x1b" not in ran.err
    assert "\x07" not in ran.err


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
