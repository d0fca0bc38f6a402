"""`register`, from a folder to a link, over an account on moto."""

from __future__ import annotations

import base64
import dataclasses
import gzip
import hashlib
import json
import re
import threading
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest

from console.problem import Exit
from deploy.aws.account import find_installation, open_account
from deploy.study import pages, register
from hippodrome import registry
from hippodrome.model import ids
from hippodrome.registry import NotRegistered
from lambdas import next_step, start_server
from testing.aws_events import ACCOUNT
from testing.files import write_files
from testing.iam.actions import Ask
from testing.iam.enforcement import account_of
from testing.iam.judge import Judge, evaluator
from tests.deploy.installation import KEYS
from tests.deploy.registering import CONFIG, Town, folder, machine, town, write_study

__all__ = ["folder", "machine", "town"]
ROOT = Path(__file__).resolve().parents[2]
LINK = "https://study.example.org/next?projectId=maze"
Capsys = pytest.CaptureFixture[str]


def configure(folder: Path, *changes: tuple[str, str]) -> None:
    text = CONFIG
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "config.yml").write_text(text)


def bodies(town: Town) -> dict[str, bytes]:
    return {key: town.get(key) for key in town.keys("maze/")}


# --- the whole way ------------------------------------------------------------------------------------------------


def test_a_folder_becomes_a_link(town: Town, folder: Path, capsys: Capsys) -> None:
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert LINK in ran.out.split()
    project = town.project()
    assert project is not None
    assert project.live
    assert (project.aws_setup.bucket, project.aws_setup.region) == (town.env["BUCKET"], "us-east-1")
    assert project.aws_setup.root_domain == "example.org"
    assert town.keys("maze/") == [f"maze/steps/{name}" for name in ("consent.html", "maze.png", "thanks.html")]
    assert [project.task_definition] == town.revisions()
    (tag,) = town.image_tags()
    assert re.fullmatch("maze-[0-9a-f]{12}", tag)
    assert town.builds[0].env["IMAGE"] == f"{town.repository}:{tag}"


def test_the_answer_for_scripts(town: Town, folder: Path, capsys: Capsys) -> None:
    answer = town.run(capsys, "register", str(folder), "--json").json
    assert answer["link"] == LINK
    assert answer["pages"] == {"uploaded": 3, "same": 0, "removed": 0}
    assert answer["imageBuilt"] is True
    assert re.fullmatch(re.escape(town.repository) + "@sha256:[0-9a-f]{64}", answer["image"])
    assert answer["taskDefinition"] == town.revisions()[0]
    assert answer["live"] is True


def test_the_task_definition(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(folder, ("cpu: 1, memory: 2", "cpu: 0.5, memory: 3"))
    answer = town.run(capsys, "register", str(folder), "--json").json
    ecs = town.client("ecs")
    found = ecs.describe_task_definition(taskDefinition="hippodrome-maze", include=["TAGS"])
    task, tags = found["taskDefinition"], {tag["key"]: tag["value"] for tag in found["tags"]}
    assert (task["cpu"], task["memory"], task["networkMode"]) == ("512", "3072", "awsvpc")
    assert task["requiresCompatibilities"] == ["FARGATE"]
    assert task["runtimePlatform"]["cpuArchitecture"] == "X86_64"
    assert task["executionRoleArn"] == town.outputs["TaskExecutionRole"]
    assert "taskRoleArn" not in task, "what runs in the container has no rights"
    assert tags["hippodrome:stack"] == "hippodrome"
    (container,) = task["containerDefinitions"]
    assert container["name"] == "trial"
    assert container["image"] == answer["image"]  # by its digest: nobody can put another image in its place
    assert container["stopTimeout"] == 120
    assert container["readonlyRootFilesystem"] is True
    assert container["linuxParameters"]["initProcessEnabled"] is True
    assert container["portMappings"][0]["containerPort"] == 443
    assert container["systemControls"] == [{"namespace": "net.ipv4.ip_unprivileged_port_start", "value": "443"}]
    assert container["user"] == "10001:10001"
    assert container["linuxParameters"]["capabilities"]["drop"] == ["ALL"]
    assert town.project().server_port == 443
    assert container["logConfiguration"]["options"]["awslogs-group"] == town.outputs["TrialLogGroup"]
    assert container["logConfiguration"]["options"]["awslogs-stream-prefix"] == "maze"
    assert container["environment"] == [{"name": "STOP_SECONDS", "value": "120"}], "nothing secret"
    assert "secrets" not in container


def test_a_study_takes_the_installations_port_when_it_is_registered_again(
    town: Town, folder: Path, capsys: Capsys
) -> None:
    town.change(ServerPort="5000")
    town.run(capsys, "register", str(folder))
    first = town.project()
    (container,) = town.client("ecs").describe_task_definition(taskDefinition=first.task_definition)["taskDefinition"][
        "containerDefinitions"
    ]
    assert (first.server_port, container["portMappings"][0]["containerPort"]) == (5000, 5000)
    assert not container.get("systemControls")
    assert "Nothing to do" in town.run(capsys, "register", str(folder), "--dry-run").out
    town.change(ServerPort="443")
    town.run(capsys, "register", str(folder))
    again = town.project()
    assert again.server_port == 443
    assert again.task_definition != first.task_definition


def test_a_participant_comes_and_a_server_starts(town: Town, tmp_path: Path, capsys: Capsys) -> None:
    """The example study as it is shipped: its page is shown, and its server is told where the certificate is."""
    study = tmp_path / "example"
    (study / "steps").mkdir(parents=True)
    (study / "config.yml").write_text((ROOT / "config.yml").read_text())
    for page in (ROOT / "steps").iterdir():
        (study / "steps" / page.name).write_bytes(page.read_bytes())
    ran = town.run(capsys, "register", str(study))
    assert ran.code == Exit.DONE, ran.err

    def get(query: str) -> dict[str, Any]:
        event = json.loads((ROOT / "tests/events/http_get.json").read_text())
        event["rawQueryString"] = query
        return next_step.handler(event, None)

    reply = get("projectId=ms-pacman&userId=ada")
    assert reply["statusCode"] == 200
    assert b"Learning to play Ms. Pac-Man" in gzip.decompress(base64.b64decode(reply["body"]))

    task = "arn:aws:ecs:us-east-1:123456789012:task/hippodrome/0123456789abcdef0123456789abcdef"
    town.answer("ecs:RunTask", {"tasks": [{"taskArn": task}], "failures": []})
    start = {"projectId": "ms-pacman", "userId": "ada", "attempt": 1}
    assert start_server.handler(town.sqs_event("start", [start]), None) == {"batchItemFailures": []}
    (call,) = [call for call in town.calls if call.action == "ecs:RunTask"]
    told = {one["name"]: one["value"] for one in call.params["overrides"]["containerOverrides"][0]["environment"]}
    assert call.params["taskDefinition"] == town.project("ms-pacman").task_definition
    assert (told["SSL_FULLCHAIN"], told["SSL_PRIVKEY"]) == (
        "SSL/servers.example.org/fullchain.pem",
        "SSL/servers.example.org/privkey.pem",
    )
    assert call.params["startedBy"] == ids.server_name(ids.server_label("ms-pacman", "ada"), 1)


def test_a_study_without_a_game_needs_no_image(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(
        folder,
        ("{1: consent, 2: game, 3: thanks}", "{1: consent, 2: thanks}"),
        ("trial:\n  game: ALE/MsPacman-v5\n", ""),
    )
    answer = town.run(capsys, "register", str(folder), "--json").json
    assert (answer["image"], answer["taskDefinition"]) == (None, None)
    assert town.project().task_definition is None
    assert (town.builds, town.image_tags(), town.revisions()) == ([], [], [])


# --- again --------------------------------------------------------------------------------------------------------


def test_nothing_changed_is_nothing_done(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    before = bodies(town)
    salt = town.project().salt
    with town.recording() as calls:
        answer = town.run(capsys, "register", str(folder), "--json").json
    writes = {"s3:DeleteObject", "ecs:RegisterTaskDefinition", "codebuild:StartBuild"}
    assert not writes & {call.action for call in calls}
    assert not [call for call in calls if call.action == "s3:PutObject" and "/steps/" in call.params["Key"]]
    assert answer["pages"] == {"uploaded": 0, "same": 3, "removed": 0}
    assert answer["imageBuilt"] is False
    assert len(town.revisions()) == 1
    assert bodies(town) == before
    assert town.project().salt == salt != ""


def test_only_the_changed_page_is_uploaded(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    (folder / "steps/consent.html").write_text("<p>May we?</p>")
    with town.recording() as calls:
        town.run(capsys, "register", str(folder))
    put = [call.params["Key"] for call in calls if call.action == "s3:PutObject"]
    assert [key for key in put if key.startswith("maze/")] == ["maze/steps/consent.html"]
    assert town.get("maze/steps/consent.html") == b"<p>May we?</p>"
    assert len(town.builds) == 1


def test_an_open_study_keeps_its_pages_until_its_image_is_there(town: Town, folder: Path, capsys: Capsys) -> None:
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    before = bodies(town)
    (folder / "steps/consent.html").write_text("<p>Another consent</p>")
    (folder / "agent.py").write_text("# another agent\n")
    town.outcome = "FAILED"
    assert town.run(capsys, "register", str(folder)).code == Exit.FAILED
    assert bodies(town) == before


def test_a_page_whose_etag_is_no_md5_is_read(town: Town, folder: Path, capsys: Capsys) -> None:
    """As with a KMS key: the ETag says nothing, the content does."""
    town.run(capsys, "register", str(folder))
    s3 = town.client("s3")
    listed = s3.list_objects_v2(Bucket=town.env["BUCKET"], Prefix="maze/steps/")["Contents"]
    lines = [{**line, "ETag": f'"{hashlib.md5(line["Key"].encode()).hexdigest()}"'} for line in listed]
    town.answer("s3:ListObjectsV2", {"Contents": lines, "IsTruncated": False})
    with town.recording() as calls:
        answer = town.run(capsys, "register", str(folder), "--json").json
    assert answer["pages"]["same"] == 3
    assert [call.params["Key"] for call in calls if call.action == "s3:GetObject" and "/steps/" in call.params["Key"]]


def test_pages_that_are_gone_go_last(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    (folder / "steps/consent.html").unlink()
    for group in range(2):
        (folder / f"steps/consent-{group}.html").write_text(f"<p>{group}</p>")
    town.put("maze/users/ada/answers/1.json", b"{}")
    town.put("maze-two/steps/consent.html", b"another project's")
    ran = town.run(capsys, "register", str(folder), "--yes")
    assert ran.code == Exit.DONE, ran.err
    assert town.keys("maze/steps/") == [
        f"maze/steps/{name}" for name in ("consent-0.html", "consent-1.html", "maze.png", "thanks.html")
    ]
    calls = [call for call in town.made if call in ("lambda:Invoke", "s3:DeleteObject")]
    assert calls == ["lambda:Invoke", "lambda:Invoke", "s3:DeleteObject"]
    assert town.get("maze-two/steps/consent.html") == b"another project's"
    assert town.get("maze/users/ada/answers/1.json") == b"{}"


def test_another_size_is_another_revision_of_the_same_image(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    configure(folder, ("memory: 2", "memory: 4"))
    town.run(capsys, "register", str(folder))
    assert len(town.builds) == 1
    assert [arn.rpartition(":")[2] for arn in town.revisions()] == ["1", "2"]
    assert town.project().task_definition == town.revisions()[1]


def test_more_pages_than_a_listing_holds(town: Town, folder: Path, capsys: Capsys) -> None:
    """S3 lists 1,000 keys at a time; here one, which is as good."""
    for name in ("a.txt", "b.txt", "c.txt"):
        town.put(f"maze/steps/{name}", b"x")
    s3 = town.client("s3")
    first = s3.list_objects_v2(Bucket=town.env["BUCKET"], Prefix="maze/steps/", MaxKeys=1)
    assert first["IsTruncated"]
    first.pop("ResponseMetadata")
    town.answer("s3:ListObjectsV2", first)
    answer = town.run(capsys, "register", str(folder), "--json").json
    assert answer["pages"] == {"uploaded": 3, "same": 0, "removed": 3}
    assert len(town.keys("maze/steps/")) == 3


# --- open and closed ----------------------------------------------------------------------------------------------


def test_closed_and_open_again(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    known = town.project()
    ran = town.run(capsys, "register", str(folder), "--no-live")
    assert ran.code == Exit.DONE, ran.err
    assert not town.project().live
    assert town.project().task_definition == known.task_definition
    assert "closed" in ran.out
    assert town.run(capsys, "register", str(folder), "--live", "--json").json["live"] is True
    assert town.project().live
    assert town.project().salt == known.salt != ""
    assert len(town.builds) == 1


def test_an_open_study_with_warm_servers_says_what_they_cost_a_day(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(folder, ("maxRuntime: 30", "maxRuntime: 30\n  warmServers: 4"))
    said = "4 servers will be kept warm while the study is open: about $2.14 a day on Spot, $5.22 on demand"
    assert said in town.run(capsys, "register", str(folder)).err.replace("\n", " ")
    assert "kept warm while" not in town.run(capsys, "register", str(folder), "--no-live").err
    project = town.project()
    assert project is not None
    assert (project.live, project.warm_servers) == (False, 4)


def test_closing_comes_before_everything(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    (folder / "agent.py").write_text("class Agent:\n    new = True\n")
    town.outcome, town.made = "FAILED", []
    ran = town.run(capsys, "register", str(folder), "--no-live")
    assert ran.code == Exit.FAILED  # the new image could not be built
    assert not town.project().live  # but nobody gets in
    assert town.made.index("lambda:Invoke") == 2


@pytest.mark.parametrize("broken", ["steps: {1: consent", "maxRuntime: never"])
def test_a_study_is_closed_although_its_config_is_broken(town: Town, folder: Path, capsys: Capsys, broken: str) -> None:
    town.run(capsys, "register", str(folder))
    where = "steps: {1: consent" if broken.startswith("steps") else "maxRuntime: 30"
    (folder / "config.yml").write_text(CONFIG.replace(where, broken.replace("consent", "nosuchpage")))
    ran = town.run(capsys, "register", str(folder), "--no-live")
    assert ran.code == Exit.FAILED
    assert "config.yml:" in ran.err
    assert not town.project().live


def test_what_is_closed_keeps_everything_else(town: Town, folder: Path, capsys: Capsys) -> None:
    """Also what records leave out because it is the default, such as 1 vCPU and 2 GB."""
    write_study(folder, steps__consent_DOT_html="x")
    configure(
        folder,
        (
            "  name: A maze\n",
            "  name: A maze\n  teamMembers: [Ada]\n  allowedHosts: [https://a.example]\n  cluster: participant\n",
        ),
        ("trial:\n", "trial:\n  options: {a: [1, {b: null}]}\n  ui: {good: true}\n"),
    )
    town.run(capsys, "register", str(folder))
    before = town.project()
    (folder / "config.yml").write_text("project:\n  id: maze\n")
    town.run(capsys, "register", str(folder), "--no-live")
    after = town.project()
    assert not after.live
    import msgspec

    assert msgspec.structs.replace(after, live=True, version=before.version) == before


def test_a_new_study_can_begin_closed(town: Town, folder: Path, capsys: Capsys) -> None:
    assert town.run(capsys, "register", str(folder), "--no-live").code == Exit.DONE
    assert town.project().live is False


def test_steps_of_a_study_under_way_change_only_after_a_yes(town: Town, folder: Path, capsys: Capsys) -> None:
    town.run(capsys, "register", str(folder))
    town.put("maze/users/ada/participant.json", b"{}")
    (folder / "steps/survey.html").write_text("<p>?</p>")
    configure(folder, ("3: thanks", "3: survey, 4: thanks"))
    before = town.project()
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DECLINED
    assert town.project() == before
    assert "maze/steps/survey.html" not in town.keys("maze/steps/")
    assert town.run(capsys, "register", str(folder), "--yes").code == Exit.DONE
    assert [step.page for step in town.project().steps] == ["consent", "game", "survey", "thanks"]


def test_a_copied_folder_with_the_same_id_takes_no_study_over_that_is_under_way_without_a_yes(
    town: Town, folder: Path, capsys: Capsys
) -> None:
    """Its pages and its agent would be those of the other study's participants."""
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    configure(folder, ("A maze", "A second study"))
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE, "nobody has taken part yet"
    configure(folder, ("A maze", "A third study"))
    town.put("maze/users/ada/participant.json", b"{}")
    before = town.project()
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DECLINED
    assert "is called A second study, and this one A third study" in ran.err
    assert town.project() == before
    assert town.run(capsys, "register", str(folder), "--yes").code == Exit.DONE
    assert town.project().name == "A third study"


# --- only looking -------------------------------------------------------------------------------------------------


def test_a_dry_run_says_everything_and_does_nothing(town: Town, folder: Path, capsys: Capsys) -> None:
    steps = town.run(capsys, "register", str(folder), "--dry-run", "--json").json["steps"]
    assert [step.split()[0] for step in steps] == ["upload", "upload", "upload", "build", "make", "register"]
    assert town.keys() == []
    assert (town.builds, town.revisions()) == ([], [])
    town.run(capsys, "register", str(folder))
    ran = town.run(capsys, "register", str(folder), "--dry-run")
    assert (ran.code, "Nothing to do" in ran.out) == (Exit.DONE, True)
    (folder / "steps/maze.png").unlink()
    before = (town.keys(), town.project())
    ran = town.run(capsys, "register", str(folder), "--dry-run", "--no-live")
    assert ran.code == Exit.CHANGES
    assert "remove maze/steps/maze.png" in ran.out
    assert "new version" in ran.out
    assert (town.keys(), town.project()) == before


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
def test_what_does_not_fit_is_told_before_anything_is_sent(
    town: Town, folder: Path, capsys: Capsys, changes: list[tuple[str, str]], said: str
) -> None:
    configure(folder, *changes)
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert said in ran.err
    assert "→" in ran.err
    assert not {"s3:PutObject", "codebuild:StartBuild", "ecs:RegisterTaskDefinition", "lambda:Invoke"} & set(town.made)


def test_all_mistakes_come_at_once(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(
        folder,
        ("maxRuntime: 30", "subdomain: userId"),
        ("memory: 2", "memory: 2, rootDomain: other.org, region: eu-west-1"),
    )
    ran = town.run(capsys, "register", str(folder))
    assert "3 mistakes" in ran.err
    assert len(re.findall(r"config\.yml:\d", ran.err)) == 3


def test_what_the_installation_has_may_be_said_too(town: Town, folder: Path, capsys: Capsys) -> None:
    same = f"memory: 2, bucket: {town.env['BUCKET']}, region: us-east-1, rootDomain: Example.org"
    ssl = f"ssl: {{sslBucket: {town.env['BUCKET']}, fullchain: SSL/fullchain.pem, privkey: SSL/privkey.pem}}"
    configure(folder, ("memory: 2", same), ("maxRuntime: 30", ssl))
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err


def test_with_strict_a_remark_is_told_before_anything_is_done(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(folder, ("trial:", "trial:\n  rows: 6"))
    ran = town.run(capsys, "register", str(folder), "--strict")
    assert ran.code == Exit.FAILED
    assert "config.yml:9: remark: trial.rows: no key of Hippodrome's" in " ".join(ran.err.split())
    assert not {"s3:PutObject", "codebuild:StartBuild", "ecs:RegisterTaskDefinition", "lambda:Invoke"} & set(town.made)
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    assert town.project().trial["options"] == {"rows": 6}


def test_a_clone_of_hippo_gym_is_registered_as_it_is(town: Town, tmp_path: Path, capsys: Capsys) -> None:
    """Its pages, its agent in App/, its id with an underscore, and nothing of HIPPO's own programs on the way."""
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
    ran = town.run(capsys, "register", str(clone))
    assert ran.code == Exit.DONE, ran.err
    assert "projectId=old_study_2" in ran.out
    assert town.keys("old_study_2/steps/") == ["old_study_2/steps/bye.html", "old_study_2/steps/hello.html"]
    project = town.project("old_study_2")
    assert [step.page for step in project.steps] == ["hello", "game", "bye"]
    assert project.trial["options"] == {"modality": "demo"}
    assert project.task_definition.split("/")[-1] == "hippodrome-old_study_2:1"
    assert town.run(capsys, "register", str(clone), "--dry-run").code == Exit.DONE, "nothing is left to do"


def test_a_template_of_hippo_gym_is_registered_with_its_last_page(town: Town, tmp_path: Path, capsys: Capsys) -> None:
    clone = tmp_path / "blank"
    (clone / "App").mkdir(parents=True)
    (clone / "App/agent.py").write_text("class Agent:\n    pass\n")
    (clone / "config.yml").write_text(
        "project: {useAWS: true, awsSetup: {cpu: , memory: }, id: blank, steps: {1: , finalStep: }}\n"
        "trial: {game: CartPole-v1}\n"
    )
    ran = town.run(capsys, "register", str(clone))
    assert ran.code == Exit.DONE, ran.err
    assert town.keys("blank/steps/") == ["blank/steps/hippodrome-the-end.html"]
    assert b"Thank you" in town.get("blank/steps/hippodrome-the-end.html")


@pytest.mark.parametrize(
    ("use", "said"), [("useAWS: true, ", "missing; give the project an id"), ("", "is empty; on AWS")]
)
def test_a_study_without_an_id_is_not_registered_by_the_name_of_its_folder(
    town: Town, tmp_path: Path, capsys: Capsys, use: str, said: str
) -> None:
    """Two clones of the same template would otherwise be one study."""
    clone = write_study(tmp_path / "HIPPO_Gym")
    configure(clone, ("id: maze", "id:"), ("  useAWS: true\n", f"  {use.rstrip(', ')}\n" if use else ""))
    ran = town.run(capsys, "register", str(clone))
    assert ran.code == Exit.FAILED
    assert f"project.id: {said}" in " ".join(ran.err.split())
    assert "lambda:Invoke" not in town.made


def test_another_bucket_and_another_certificate_are_said_to_have_no_effect(
    town: Town, folder: Path, capsys: Capsys
) -> None:
    ssl = "ssl: {sslBucket: certs, fullchain: a.pem, privkey: b.pem}"
    configure(folder, ("memory: 2", "memory: 2, bucket: lab.projects"), ("maxRuntime: 30", ssl))
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    said = " ".join((ran.out + ran.err).split())
    assert "config.yml:4: remark: project.ssl: no effect: servers get the certificate of the installation" in said
    here = town.env["BUCKET"]
    assert (
        f"config.yml:7: remark: project.awsSetup.bucket: no effect: it is lab.projects, and the study's pages and data are in {here}"
        in said
    )
    assert town.project().aws_setup.bucket == here


def test_a_runtime_beyond_the_installations_is_the_installations(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(folder, ("maxRuntime: 30", "maxRuntime: 600"))
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    said = " ".join((ran.out + ran.err).split())
    assert (
        "config.yml:4: remark: project.maxRuntime: is 600 minutes; the installation hippodrome stops servers at 120"
        in said
    )
    assert town.project().max_runtime == 120


def test_an_agent_that_python_cannot_read(town: Town, folder: Path, capsys: Capsys) -> None:
    (folder / "agent.py").write_text("class Agent:\n    def step(self\n        pass\n")
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert re.search(r"agent\.py:\d: Python cannot read this", ran.err)
    assert town.made == []


def test_no_folder(town: Town, tmp_path: Path, capsys: Capsys) -> None:
    ran = town.run(capsys, "register", str(tmp_path / "nowhere"))
    assert (ran.code, "there is no such folder" in ran.err) == (Exit.FAILED, True)
    ran = town.run(capsys, "register", str(tmp_path / "nowhere"), "--no-live")
    assert (ran.code, "there is no such folder" in ran.err) == (Exit.FAILED, True)


def test_another_region_has_no_stack(town: Town, folder: Path, capsys: Capsys) -> None:
    ran = town.run(capsys, "register", str(folder), "--region", "eu-west-1")
    assert ran.code == Exit.FAILED
    assert "no stack named hippodrome in eu-west-1" in ran.err


@pytest.mark.parametrize("name", ["link", "picture"])
def test_pages_that_must_not_be_uploaded(town: Town, folder: Path, capsys: Capsys, name: str) -> None:
    if name == "link":
        (folder / "steps/keys.txt").symlink_to("/etc/passwd")
    else:
        (folder / "steps/film.mp4").write_bytes(b"x" * (pages.LIMIT_BYTES + 1))
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert ("link out of the project folder" if name == "link" else "larger than 4 MB") in ran.err
    assert town.keys() == []


def test_hidden_files_and_folders_are_no_pages(town: Town, folder: Path, capsys: Capsys) -> None:
    write_study(folder, steps___DOT_DS_Store="x", steps__drafts__a_DOT_html="x")
    assert town.run(capsys, "register", str(folder), "--json").json["pages"]["uploaded"] == 3


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
def test_what_aws_refuses_is_a_sentence_and_the_next_run_goes_on(
    town: Town, folder: Path, capsys: Capsys, action: str, code: str, said: str
) -> None:
    town.fail(action, code)
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert said in ran.err
    assert town.project() is None
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    assert len(town.builds) <= 1
    assert len(town.revisions()) == 1


def test_the_functions_objections_are_told(
    town: Town, folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    def objects(*_: object) -> None:
        raise NotRegistered(["project.maxRuntime is too long", "project.steps.1: consent.html has not been uploaded"])

    with monkeypatch.context() as patch:
        patch.setattr("hippodrome.registry.register", objects)
        ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "project.maxRuntime is too long" in ran.err
    assert "consent.html has not been uploaded" in ran.err
    assert LINK not in ran.out


def test_a_function_that_is_older_than_a_key_of_the_study_is_to_be_brought_up_to_date(
    town: Town, folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Here the study has a key more; what the function says of it is the same."""
    known = registry.register

    def older(platform: Any, registration: dict[str, Any]) -> Any:
        return known(platform, {**registration, "keyOfTomorrow": 2})

    with monkeypatch.context() as patch:
        patch.setattr("hippodrome.registry.register", older)
        ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "keyOfTomorrow: unknown key" in ran.err
    assert "The installation is older than this study: bring it up to date with `make deploy`" in ran.err
    assert LINK not in ran.out


def test_a_function_that_fails_is_told(town: Town, folder: Path, capsys: Capsys) -> None:
    town.function_error = True
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.FAILED
    assert "function that registers projects failed" in ran.err


def test_ctrl_c_anywhere_leaves_nothing_half_seen(town: Town, tmp_path: Path, capsys: Capsys) -> None:
    """Interrupted after each change of a run in turn: the project is registered in full or not at all, and the next run
    completes it without uploading, building or making a revision twice."""
    whole = write_study(tmp_path / "whole", CONFIG.replace("id: maze", "id: whole"))
    assert town.run(capsys, "register", str(whole)).code == Exit.DONE
    calls = town.made
    assert calls[-1] == "lambda:Invoke"
    changes = {"s3:PutObject", "codebuild:StartBuild", "codebuild:BatchGetBuilds", "ecs:RegisterTaskDefinition"}
    places = [n for n, action in enumerate(calls) if not n or calls[n - 1] in changes or action == "lambda:Invoke"]
    assert len(places) > 8
    for place in places:
        what, name = (place, calls[place]), f"maze-{place}"
        folder = write_study(tmp_path / name, CONFIG.replace("id: maze", f"id: {name}"))
        town.made, town.builds, town.calls, town.interrupt = [], [], [], place
        ran = town.run(capsys, "register", str(folder))
        assert ran.code == Exit.INTERRUPTED, what
        assert "goes on from here" in ran.err
        assert town.project(name) is None, what
        town.interrupt = None
        ran = town.run(capsys, "register", str(folder))
        assert ran.code == Exit.DONE, (what, ran.err)
        assert [town.project(name).task_definition] == town.revisions(f"hippodrome-{name}"), what
        assert len(town.keys(f"{name}/steps/")) == 3
        assert len(town.builds) == 1, what
        written = [call.params["Key"] for call in town.calls if call.action == "s3:PutObject"]
        cut_off = calls[place] == "s3:PutObject"  # it is counted, but never arrived
        assert len(set(written)) == len(written) - cut_off, what


# --- several people -----------------------------------------------------------------------------------------------


def _together(town: Town, *folders: Path) -> list[dict[str, Any] | BaseException]:
    """Register these folders at the same moment."""
    account = open_account(region="us-east-1")
    installation = find_installation(account)
    gate, results = threading.Barrier(len(folders)), [None] * len(folders)

    def work(index: int, folder: Path) -> None:
        gate.wait()
        try:
            results[index] = register.register(
                open_account(region="us-east-1"), installation, folder, register.RegisterRequest()
            )
        except BaseException as error:  # noqa: BLE001 - whatever it was, it is looked at
            results[index] = error

    threads = [threading.Thread(target=work, args=one) for one in enumerate(folders)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return results


def test_two_researchers_at_once_lose_nothing(town: Town, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    names = [f"study-{number}" for number in range(4)]
    folders = [write_study(tmp_path / name, CONFIG.replace("id: maze", f"id: {name}")) for name in names]
    results = _together(town, *folders)
    assert [result["project"] for result in results] == names, results
    for name in names:
        project = town.project(name)
        assert project is not None
        assert [project.task_definition] == town.revisions(f"hippodrome-{name}")
        assert len(town.keys(f"{name}/steps/")) == 3


def test_of_two_who_register_the_same_study_one_wins_whole(
    town: Town, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    folders = [
        write_study(tmp_path / who, CONFIG.replace("A maze", who), steps__thanks_DOT_html=who) for who in ("Ada", "Bob")
    ]
    results = _together(town, *folders)
    assert all(isinstance(result, dict) for result in results), results
    assert town.project().name in ("Ada", "Bob")
    assert town.get("maze/steps/thanks.html") in (b"Ada", b"Bob")
    assert len(town.image_tags()) == 1


# --- what a researcher must be allowed ----------------------------------------------------------------------------


def _asks(town: Town, action: str, params: dict[str, Any]) -> list[Ask]:
    """What a call of `register` needs, by AWS's Service Authorization Reference."""
    here, bucket = f"us-east-1:{ACCOUNT}", f"arn:aws:s3:::{town.env['BUCKET']}"
    stack, families = f"arn:aws:cloudformation:{here}:stack/hippodrome/1", f"arn:aws:ecs:{here}:task-definition"
    service, operation = action.split(":")
    if service == "s3":
        name = {"HeadObject": "GetObject", "ListObjectsV2": "ListBucket"}.get(operation, operation)
        return [Ask(f"s3:{name}", bucket if name == "ListBucket" else f"{bucket}/{params['Key']}")]
    if action == "ecs:RegisterTaskDefinition":
        new = f"{families}/{params['family']}:*"
        to = {"iam:PassedToService": "ecs-tasks.amazonaws.com"}
        tag = Ask("ecs:TagResource", new, {"ecs:CreateAction": "RegisterTaskDefinition"})
        return [Ask(action, new), tag, Ask("iam:PassRole", params["executionRoleArn"], to)]
    return [
        {
            "cloudformation:DescribeStacks": Ask(action, stack),
            "codebuild:BatchGetBuilds": Ask(action, f"arn:aws:codebuild:{here}:project/hippodrome-image"),
            "codebuild:ListBuildsForProject": Ask(action, f"arn:aws:codebuild:{here}:project/hippodrome-image"),
            "codebuild:StartBuild": Ask(action, f"arn:aws:codebuild:{here}:project/hippodrome-image"),
            "ecr:DescribeImages": Ask(action, f"arn:aws:ecr:{here}:repository/hippodrome"),
            "ecs:DescribeTaskDefinition": Ask(action, "*"),
            "lambda:Invoke": Ask(
                "lambda:InvokeFunction", f"arn:aws:lambda:{here}:function:{town.outputs['RegisterFunction']}"
            ),
            "logs:GetLogEvents": Ask(
                action, f"arn:aws:logs:{here}:log-group:/hippodrome/hippodrome/image:log-stream:1"
            ),
        }[action]
    ]


@pytest.mark.skipif(evaluator() is None, reason="no evaluator of policies is installed; tests/infra says so aloud")
def test_researchers_may_do_all_of_it_and_not_more(town: Town, folder: Path, capsys: Capsys) -> None:
    repository, builder = f"arn:aws:ecr:us-east-1:{ACCOUNT}:repository/hippodrome", "hippodrome-image"
    account = account_of(town)
    function = f"arn:aws:lambda:us-east-1:{ACCOUNT}:function:{town.outputs['RegisterFunction']}"
    project = f"arn:aws:codebuild:us-east-1:{ACCOUNT}:project/{builder}"
    known = {"Repository.Arn": repository, "ImageBuilder.Arn": project, "UpdateProjectMasterList.Arn": function}
    judge = Judge(dataclasses.replace(account, known={**account.known, **known}))
    assert town.run(capsys, "register", str(folder)).code == Exit.DONE
    (folder / "steps/maze.png").unlink()
    (folder / "agent.py").write_text("class Agent:\n    x = 1\n")
    assert town.run(capsys, "register", str(folder), "--no-live").code == Exit.DONE
    assert "s3:DeleteObject" in town.made
    for action, params in town.asked:
        for ask in _asks(town, action, params):
            assert judge.may("ResearcherPolicy", ask), ask
    bucket = f"arn:aws:s3:::{town.env['BUCKET']}"
    for ask in (
        Ask("s3:PutObject", f"{bucket}/project_master_list.json"),
        Ask("s3:PutObject", f"{bucket}/maze/users/ada/answers/1.json"),
        Ask("s3:DeleteObject", f"{bucket}/maze/users/ada/answers/1.json"),
        Ask("s3:GetObject", f"{bucket}/SSL/privkey.pem"),
        Ask("iam:PassRole", f"arn:aws:iam::{ACCOUNT}:role/admin", {"iam:PassedToService": "ecs-tasks.amazonaws.com"}),
        Ask("ecr:BatchDeleteImage", repository),
        Ask("ecs:RunTask", f"arn:aws:ecs:us-east-1:{ACCOUNT}:task-definition/hippodrome-maze:1"),
    ):
        assert not judge.may("ResearcherPolicy", ask), ask


# --- the link -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "magic"), [("a.svg", b"<?xml"), ("a.PNG", b"\x89PNG"), ("a.pdf", b"%PDF")])
def test_a_qr_code_in_a_file(town: Town, folder: Path, tmp_path: Path, capsys: Capsys, name: str, magic: bytes) -> None:
    ran = town.run(capsys, "register", str(folder), "--qr", str(tmp_path / name))
    assert ran.code == Exit.DONE, ran.err
    assert (tmp_path / name).read_bytes().startswith(magic)


@pytest.mark.parametrize("name", ["poster.docx", "nowhere/poster.svg"])
def test_a_qr_code_that_cannot_be_written_is_told_first(town: Town, folder: Path, capsys: Capsys, name: str) -> None:
    ran = town.run(capsys, "register", str(folder), "--qr", str(folder / name))
    assert ran.code == Exit.FAILED
    assert town.made == []


def test_on_a_terminal_the_qr_code_is_shown(
    town: Town, folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deploy.study.register.sys.stdout.isatty", lambda: True, raising=False)
    ran = town.run(capsys, "register", str(folder))
    assert re.search("[▀▄█]{4}", ran.out)


def test_no_link_is_shown_that_would_let_nobody_in(
    town: Town, folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("deploy.study.register.sys.stdout.isatty", lambda: True, raising=False)
    configure(folder, ("maxRuntime: 30", "signedLinks: true"))
    answer = town.run(capsys, "register", str(folder), "--json").json
    assert (answer["signedLinks"], answer["link"]) == (True, None)
    ran = town.run(capsys, "register", str(folder))
    assert "/next?" not in ran.out
    assert not re.search("[▀▄█]", ran.out)
    assert "python -m deploy links --project maze --new 50" in ran.out
    made = town.run(capsys, "links", "--project", "maze", "--new", "50")
    assert made.out.count("&signature=") == 50


def test_a_study_with_signed_links_has_no_qr_code(town: Town, folder: Path, capsys: Capsys) -> None:
    configure(folder, ("maxRuntime: 30", "signedLinks: true"))
    ran = town.run(capsys, "register", str(folder), "--qr", str(folder.parent / "a.svg"))
    assert ran.code == Exit.FAILED
    assert "each participant has a link of their own" in ran.err
    assert town.made == []
    closed = town.run(capsys, "register", str(folder), "--no-live", "--qr", str(folder.parent / "a.svg"))
    assert closed.code == Exit.DONE
    assert "each participant has a link of their own" in closed.err
    assert not (folder.parent / "a.svg").exists()


def test_the_link_is_the_one_in_the_documents() -> None:
    text = (ROOT / "docs/recruiting.md").read_text()
    assert "https://…/next?projectId=your-project" in text


def test_the_documented_options_exist(town: Town, capsys: Capsys) -> None:
    shown = town.run(capsys, "register", "--help").out
    for option in re.findall(r"`(--[a-z-]+)", (ROOT / "docs/aws-project.md").read_text()):
        assert option in shown


# --- what the image lacks -----------------------------------------------------------------------------------------


def test_a_package_that_the_image_lacks_is_named_before_the_image_is_built(
    town: Town, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_study(folder, agent_DOT_py="import numpy\nimport psutil\n\n\nclass Agent:\n    pass\n")
    ran = town.run(capsys, "register", str(folder))
    assert ran.code == Exit.DONE, ran.err
    line = f"write psutil=={version('psutil')} into requirements.txt"
    told = " ".join(ran.err.split())
    assert line in told
    assert told.index(line) < told.index("Building the image")
    write_study(
        folder, agent_DOT_py="import psutil\n\n\nclass Agent:\n    pass\n", requirements_DOT_txt="psutil\nnumpy\n"
    )
    assert "psutil==" not in town.run(capsys, "register", str(folder)).err
