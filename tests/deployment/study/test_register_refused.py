"""`register` reports mistakes, refusals of AWS, and packages that the image lacks."""

from __future__ import annotations

import re
import unicodedata
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.control import registry
from hippodrome.control.participants.files import MAX_BYTES
from hippodrome.control.registry import NotRegistered
from testing.files import write_files
from tests.deployment.registering import CONFIG, Register, RegisterWorld, configure, write_study

LINK = "https://study.example.org/next?projectId=maze"
Capsys = pytest.CaptureFixture[str]


# --- mistakes -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ([("cpu: 1, memory: 2", "cpu: 1, memory: 2, region: eu-west-1")], "config.yml:7: project.awsSetup.region: is eu-west-1, but"),
        ([("cpu: 1, memory: 2", "cpu: 1, memory: 2, rootDomain: other.org")], "config.yml:7: project.awsSetup.rootDomain: is other.org, but"),
        ([("maxRuntime: 30", "maxRuntime: 70\n  warmServers: 2")], "config.yml:5: project.warmServers: is 2: with an hour of waiting and maxRuntime, a server may need 130 minutes, and this installation allows 120"),
        ([("maxRuntime: 30", "subdomain: userId")], "config.yml:4: project.subdomain: is userId, which this installation does not allow"),
        ([("maxRuntime: 30", "plainClients: true\n  frontEnd: https://play.example.org\n  subdomain: userId")], "config.yml:4: project.plainClients: is true, which this installation does not allow (PlainClients); use false"),
        ([("useAWS: true", "useAWS: false")], "config.yml:6: project.useAWS: is false, which keeps this study on one machine; write true"),
        (
            [("  useAWS: true\n", ""), ("  awsSetup: {cpu: 1, memory: 2}\n", "")],
            "project.awsSetup: gives no cpu and no memory; on AWS each participant gets a server: write how large",
        ),
        ([("  useAWS: true\n", ""), ("cpu: 1, memory: 2", "cpu: 1, memory: 9")], "project.awsSetup.memory: 9 GB do not go with cpu 1"),
        ([("id: maze", "id: SSL")], "config.yml:2: project.id: must not be SSL"),
        ([("1: consent", "1: consnt")], "there is no consnt.html in steps/; did you mean consent?"),
        ([("cpu: 1, ", "")], "project.awsSetup.cpu: missing"),
        ([("trial:", "trail:")], "config.yml:8:"),
    ],
)  # fmt: skip
def test_mistakes_are_reported_before_anything_is_sent(
    register_world: RegisterWorld, folder: Path, changes: list[tuple[str, str]], said: str, register: Register
) -> None:
    configure(folder, *changes)
    ran = register(code=Exit.FAILED)
    assert said in ran.err
    assert "→" in ran.err
    assert not {"s3:PutObject", "ecr:GetAuthorizationToken", "ecs:RegisterTaskDefinition", "lambda:Invoke"} & set(
        register_world.made
    )


def test_all_mistakes_are_reported_at_once(folder: Path, register: Register) -> None:
    configure(
        folder,
        ("maxRuntime: 30", "subdomain: userId"),
        ("memory: 2", "memory: 2, rootDomain: other.org, region: eu-west-1"),
    )
    ran = register()
    assert "3 mistakes" in ran.err
    assert len(re.findall(r"config\.yml:\d", ran.err)) == 3


def test_keys_that_repeat_the_installation_are_accepted(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    same = f"memory: 2, bucket: {register_world.env['BUCKET']}, region: us-east-1, rootDomain: Example.org"
    ssl = f"ssl: {{sslBucket: {register_world.env['BUCKET']}, fullchain: SSL/fullchain.pem, privkey: SSL/privkey.pem}}"
    configure(folder, ("memory: 2", same), ("maxRuntime: 30", ssl))
    register(code=Exit.DONE)


def test_with_strict_a_remark_stops_register_beforehand(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    configure(folder, ("trial:", "trial:\n  rows: 6"))
    ran = register("--strict", code=Exit.FAILED)
    assert "config.yml:9: remark: trial.rows: no key of Hippodrome's" in " ".join(ran.err.split())
    assert not {"s3:PutObject", "ecr:GetAuthorizationToken", "ecs:RegisterTaskDefinition", "lambda:Invoke"} & set(
        register_world.made
    )
    register(code=Exit.DONE)
    assert register_world.project().trial["options"] == {"rows": 6}


def test_a_clone_of_hippo_gym_is_registered_as_it_is(
    register_world: RegisterWorld, tmp_path: Path, capsys: Capsys
) -> None:
    """Its pages, its agent in App/ and its id with an underscore are registered, and none of HIPPO's own programs."""
    files = {
        "config.yml": """\
project:
  useAWS: True
  awsSetup: {bucket: lab.projects, region: , rootDomain: , cpu: 2, memory: 10}
  events: {startServerStep: 1, stopServerStep: 12}
  id: old_study_2
  live: True
  maxRuntime: 30
  ssl: {fullchain: SSL/fullchain.pem, privkey: SSL/privkey.pem, sslBucket: lab.projects}
  steps: {1: StepFiles/hello.html, 2: game, 3: bye.html, finalStep: bye.html}
trial:
  game: CartPole-v1
  modality: demo
""",
        "App/agent.py": "class Agent:\n    pass\n",
        "App/trial.py": "from agent import Agent\n",
        "StepFiles/hello.html": "<p>hello</p>",
        "StepFiles/bye.html": "<p>bye</p>",
        "requirements.txt": "gym==0.17.2\nnumpy==1.18.5\n",
        "Dockerfile": "FROM python:3.7\n",
    }
    clone = write_files(tmp_path / "clone", files)
    ran = register_world.run(capsys, "register", str(clone))
    assert ran.code == Exit.DONE, ran.err
    assert "projectId=old_study_2" in ran.out
    assert register_world.keys("old_study_2/steps/") == ["old_study_2/steps/bye.html", "old_study_2/steps/hello.html"]
    project = register_world.project("old_study_2")
    assert [step.page for step in project.steps] == ["hello", "game", "bye"]
    assert project.trial["options"] == {"modality": "demo"}
    assert project.task_definition.split("/")[-1] == "hippodrome-old_study_2:1"
    assert register_world.run(capsys, "register", str(clone), "--dry-run").code == Exit.DONE, "nothing is left to do"


def test_a_template_of_hippo_gym_is_registered_with_its_last_page(
    register_world: RegisterWorld, tmp_path: Path, capsys: Capsys
) -> None:
    clone = tmp_path / "blank"
    (clone / "App").mkdir(parents=True)
    (clone / "App/agent.py").write_text("class Agent:\n    pass\n")
    (clone / "config.yml").write_text(
        "project: {useAWS: true, awsSetup: {cpu: , memory: }, id: blank, steps: {1: , finalStep: }}\n"
        "trial: {game: CartPole-v1}\n"
    )
    ran = register_world.run(capsys, "register", str(clone))
    assert ran.code == Exit.DONE, ran.err
    assert register_world.keys("blank/steps/") == ["blank/steps/hippodrome-the-end.html"]
    assert b"Thank you" in register_world.get("blank/steps/hippodrome-the-end.html")


@pytest.mark.parametrize(
    ("use", "said"), [("useAWS: true, ", "missing; give the project an id"), ("", "is empty; on AWS")]
)
def test_a_study_without_an_id_is_not_registered_by_the_name_of_its_folder(
    register_world: RegisterWorld, tmp_path: Path, capsys: Capsys, use: str, said: str
) -> None:
    """Otherwise two clones of the same template would be one study."""
    clone = write_study(tmp_path / "HIPPO_Gym")
    configure(clone, ("id: maze", "id:"), ("  useAWS: true\n", f"  {use.rstrip(', ')}\n" if use else ""))
    ran = register_world.run(capsys, "register", str(clone))
    assert ran.code == Exit.FAILED
    assert f"project.id: {said}" in " ".join(ran.err.split())
    assert "lambda:Invoke" not in register_world.made


def test_register_says_that_another_bucket_and_certificate_have_no_effect(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    ssl = "ssl: {sslBucket: certs, fullchain: a.pem, privkey: b.pem}"
    configure(folder, ("memory: 2", "memory: 2, bucket: lab.projects"), ("maxRuntime: 30", ssl))
    ran = register(code=Exit.DONE)
    said = " ".join((ran.out + ran.err).split())
    assert "config.yml:4: remark: project.ssl: no effect: servers get the certificate of the installation" in said
    here = register_world.env["BUCKET"]
    assert (
        f"config.yml:7: remark: project.awsSetup.bucket: no effect: it is lab.projects, and the study's pages and data are in {here}"
        in said
    )
    assert register_world.project().aws_setup.bucket == here


def test_a_longer_runtime_than_the_installations_is_reduced_to_it(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    configure(folder, ("maxRuntime: 30", "maxRuntime: 600"))
    ran = register(code=Exit.DONE)
    said = " ".join((ran.out + ran.err).split())
    assert (
        "config.yml:4: remark: project.maxRuntime: is 600 minutes; the installation hippodrome stops servers at 120"
        in said
    )
    assert register_world.project().max_runtime == 120


def test_an_agent_with_a_syntax_error_is_refused(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    (folder / "agent.py").write_text("class Agent:\n    def step(self\n        pass\n")
    ran = register(code=Exit.FAILED)
    assert re.search(r"agent\.py:\d: Python cannot read this", ran.err)
    assert register_world.made == []


def test_a_file_that_hides_a_package_of_the_servers_is_refused(folder: Path, register: Register) -> None:
    (folder / "numpy.py").touch()
    ran = register(code=Exit.FAILED)
    assert "agent.py: numpy.py hides the package numpy, which servers need; rename it" in ran.err


def test_a_missing_folder_is_reported(register_world: RegisterWorld, tmp_path: Path, capsys: Capsys) -> None:
    ran = register_world.run(capsys, "register", str(tmp_path / "nowhere"))
    assert (ran.code, "there is no such folder" in ran.err) == (Exit.FAILED, True)
    ran = register_world.run(capsys, "register", str(tmp_path / "nowhere"), "--no-live")
    assert (ran.code, "there is no such folder" in ran.err) == (Exit.FAILED, True)


def test_register_in_another_region_says_that_there_is_no_stack(register: Register) -> None:
    ran = register("--region", "eu-west-1", code=Exit.FAILED)
    assert "no stack named hippodrome in eu-west-1" in ran.err


@pytest.mark.parametrize("name", ["link", "picture"])
def test_links_out_of_the_folder_and_large_pages_are_refused(
    register_world: RegisterWorld, folder: Path, name: str, register: Register
) -> None:
    if name == "link":
        (folder / "steps/keys.txt").symlink_to("/etc/passwd")
    else:
        (folder / "steps/film.mp4").write_bytes(b"x" * (MAX_BYTES + 1))
    ran = register(code=Exit.FAILED)
    assert ("link out of the project folder" if name == "link" else "larger than 4 MB") in ran.err
    assert register_world.keys() == []


def test_hidden_files_and_folders_are_not_uploaded(folder: Path, register: Register) -> None:
    write_study(folder, steps___DOT_DS_Store="x", steps__drafts__a_DOT_html="x")
    assert register("--json").json["pages"]["uploaded"] == 3


def test_a_file_from_a_mac_has_the_name_that_pages_write(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    (folder / "steps" / unicodedata.normalize("NFD", "Übung.png")).touch()
    register()
    uploaded = register_world.keys()
    assert "steps/Übung.png" in {key.partition("/")[2] for key in uploaded}


# --- failures on the way ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "code", "said"),
    [
        ("s3:ListObjectsV2", "AccessDenied", "may not list objects"),
        ("s3:PutObject", "AccessDenied", "may not put object"),
        ("ecr:DescribeImages", "RepositoryNotFoundException", "repository hippodrome is not there"),
        ("ecs:RegisterTaskDefinition", "AccessDeniedException", "may not register task definition"),
        ("ecs:DescribeTaskDefinition", "ThrottlingException", "busy"),
        ("lambda:Invoke", "AccessDeniedException", "may not invoke"),
        ("lambda:Invoke", "ResourceNotFoundException", "would not invoke"),
    ],
)
def test_a_refusal_of_aws_is_reported_in_a_sentence_and_the_next_run_finishes(
    register_world: RegisterWorld, action: str, code: str, said: str, register: Register
) -> None:
    register_world.fail(action, code)
    ran = register(code=Exit.FAILED)
    assert said in ran.err
    assert register_world.project() is None
    ran = register(code=Exit.DONE)
    assert len(register_world.builds) <= 1
    assert len(register_world.revisions()) == 1


def test_mistakes_that_the_function_finds_are_reported(monkeypatch: pytest.MonkeyPatch, register: Register) -> None:
    def objects(*_: object) -> None:
        raise NotRegistered(["project.maxRuntime is too long", "project.steps.1: consent.html has not been uploaded"])

    with monkeypatch.context() as patch:
        patch.setattr("hippodrome.control.registry.register", objects)
        ran = register()
    assert ran.code == Exit.FAILED
    assert "project.maxRuntime is too long" in ran.err
    assert "consent.html has not been uploaded" in ran.err
    assert LINK not in ran.out


def test_register_advises_an_update_if_the_function_does_not_know_a_key(
    monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    """Here the study has an additional key; the message of an older function would be the same."""
    known = registry.register

    def older(platform: Any, registration: dict[str, Any]) -> Any:
        return known(platform, {**registration, "keyOfTomorrow": 2})

    with monkeypatch.context() as patch:
        patch.setattr("hippodrome.control.registry.register", older)
        ran = register()
    assert ran.code == Exit.FAILED
    assert "keyOfTomorrow: unknown key" in ran.err
    assert "The installation is older than this study: bring it up to date with" in ran.err
    assert LINK not in ran.out


def test_a_failure_of_the_function_is_reported(register_world: RegisterWorld, register: Register) -> None:
    register_world.function_error = True
    ran = register(code=Exit.FAILED)
    assert "function that registers projects failed" in ran.err


def test_ctrl_c_at_any_change_leaves_no_half_registered_project(
    register_world: RegisterWorld, tmp_path: Path, capsys: Capsys
) -> None:
    """Interrupted after each change of a run in turn: the project is registered in full or not at all, and the next run
    completes it without uploading, building or making a revision twice."""
    whole = write_study(tmp_path / "whole", CONFIG.replace("id: maze", "id: whole"))
    assert register_world.run(capsys, "register", str(whole)).code == Exit.DONE
    calls = register_world.made
    assert calls[-1] == "lambda:Invoke"
    changes = {"s3:PutObject", "ecr:GetAuthorizationToken", "ecs:RegisterTaskDefinition"}
    places = [n for n, action in enumerate(calls) if not n or calls[n - 1] in changes or action == "lambda:Invoke"]
    assert len(places) > 5
    for place in places:
        what, name = (place, calls[place]), f"maze-{place}"
        folder = write_study(tmp_path / name, CONFIG.replace("id: maze", f"id: {name}"))
        register_world.made, register_world.builds, register_world.calls, register_world.interrupt = [], [], [], place
        ran = register_world.run(capsys, "register", str(folder))
        assert ran.code == Exit.INTERRUPTED, what
        assert "goes on from here" in ran.err
        assert register_world.project(name) is None, what
        register_world.interrupt = None
        ran = register_world.run(capsys, "register", str(folder))
        assert ran.code == Exit.DONE, (what, ran.err)
        assert [register_world.project(name).task_definition] == register_world.revisions(f"hippodrome-{name}"), what
        assert len(register_world.keys(f"{name}/steps/")) == 3
        assert len(register_world.builds) == 1, what
        written = [call.params["Key"] for call in register_world.calls if call.action == "s3:PutObject"]
        cut_off = calls[place] == "s3:PutObject"  # the call is counted, but was never executed
        assert len(set(written)) == len(written) - cut_off, what


# --- what the image lacks -----------------------------------------------------------------------------------------


def test_a_missing_package_is_reported_before_the_build(folder: Path, register: Register) -> None:
    write_study(folder, agent_DOT_py="import numpy\nimport psutil\n\n\nclass Agent:\n    pass\n")
    ran = register(code=Exit.DONE)
    line = f"write psutil=={version('psutil')} into requirements.txt"
    told = " ".join(ran.err.split())
    assert line in told
    assert told.index(line) < told.index("Assembling the image")
    write_study(
        folder, agent_DOT_py="import psutil\n\n\nclass Agent:\n    pass\n", requirements_DOT_txt="psutil\nnumpy\n"
    )
    assert "psutil==" not in register().err
