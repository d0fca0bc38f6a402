"""`register`, from a folder to a link, over an account on moto."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
from pathlib import Path
from typing import Any

import pytest

from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids
from hippodrome.functions import next_step, start_server
from tests.deployment.registering import (
    CONFIG,
    Register,
    RegisterWorld,
    bodies,
    configure,
    write_study,
)

ROOT = Path(__file__).resolve().parents[3]
LINK = "https://study.example.org/next?projectId=maze"
Capsys = pytest.CaptureFixture[str]


# --- the whole way ------------------------------------------------------------------------------------------------


def test_a_folder_becomes_a_link(register_world: RegisterWorld, register: Register) -> None:
    ran = register(code=Exit.DONE)
    assert LINK in ran.out.split()
    project = register_world.project()
    assert project is not None
    assert project.live
    assert (project.aws_setup.bucket, project.aws_setup.region) == (register_world.env["BUCKET"], "us-east-1")
    assert project.aws_setup.root_domain == "example.org"
    assert register_world.keys("maze/") == [
        f"maze/steps/{name}" for name in ("consent.html", "maze.png", "thanks.html")
    ]
    assert [project.task_definition] == register_world.revisions()
    (tag,) = register_world.image_tags()
    assert re.fullmatch("maze-[0-9a-f]{12}", tag)
    assert register_world.builds[0].image == f"{register_world.repository}:{tag}"


def test_register_answers_in_json(register_world: RegisterWorld, register: Register) -> None:
    answer = register("--json").json
    assert answer["link"] == LINK
    assert answer["pages"] == {"uploaded": 3, "same": 0, "removed": 0}
    assert answer["imageBuilt"] is True
    assert re.fullmatch(re.escape(register_world.repository) + "@sha256:[0-9a-f]{64}", answer["image"])
    assert answer["taskDefinition"] == register_world.revisions()[0]
    assert answer["live"] is True


def test_register_makes_the_task_definition(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    configure(folder, ("cpu: 1, memory: 2", "cpu: 0.5, memory: 3"))
    answer = register("--json").json
    ecs = register_world.client("ecs")
    found = ecs.describe_task_definition(taskDefinition="hippodrome-maze", include=["TAGS"])
    task, tags = found["taskDefinition"], {tag["key"]: tag["value"] for tag in found["tags"]}
    assert (task["cpu"], task["memory"], task["networkMode"]) == ("512", "3072", "awsvpc")
    assert task["requiresCompatibilities"] == ["FARGATE"]
    assert task["runtimePlatform"]["cpuArchitecture"] == "X86_64"
    assert task["executionRoleArn"] == register_world.outputs["TaskExecutionRole"]
    assert "taskRoleArn" not in task, "what runs in the container has no rights"
    assert tags["hippodrome:stack"] == "hippodrome"
    (container,) = task["containerDefinitions"]
    assert container["name"] == "trial"
    assert container["image"] == answer["image"]  # by its digest: nobody can put another image in its place
    assert container["stopTimeout"] == 120
    assert container["readonlyRootFilesystem"] is True
    assert container["linuxParameters"]["initProcessEnabled"] is True
    assert container["portMappings"][0]["containerPort"] == 443
    assert container["systemControls"] == [{"namespace": "net.ipv4.ip_unprivileged_port_start", "value": "80"}]
    assert container["user"] == "10001:10001"
    assert container["linuxParameters"]["capabilities"]["drop"] == ["ALL"]
    assert register_world.project().server_port == 443
    assert container["logConfiguration"]["options"]["awslogs-group"] == register_world.outputs["TrialLogGroup"]
    assert container["logConfiguration"]["options"]["awslogs-stream-prefix"] == "maze"
    assert container["environment"] == [{"name": "STOP_SECONDS", "value": "120"}], "nothing secret"
    assert "secrets" not in container


def test_a_study_takes_the_installations_port_when_it_is_registered_again(
    register_world: RegisterWorld, register: Register
) -> None:
    register_world.change(ServerPort="5000")
    register()
    first = register_world.project()
    (container,) = register_world.client("ecs").describe_task_definition(taskDefinition=first.task_definition)[
        "taskDefinition"
    ]["containerDefinitions"]
    assert (first.server_port, container["portMappings"][0]["containerPort"]) == (5000, 5000)
    assert not container.get("systemControls")
    assert "Nothing to do" in register("--dry-run").out
    register_world.change(ServerPort="443")
    register()
    again = register_world.project()
    assert again.server_port == 443
    assert again.task_definition != first.task_definition


def test_a_participant_comes_and_a_server_starts(register_world: RegisterWorld, tmp_path: Path, capsys: Capsys) -> None:
    """The unchanged example study: its page is shown, and its server gets the place of the certificate."""
    study = tmp_path / "example"
    (study / "steps").mkdir(parents=True)
    (study / "config.yml").write_text((ROOT / "config.yml").read_text())
    for page in (ROOT / "steps").iterdir():
        (study / "steps" / page.name).write_bytes(page.read_bytes())
    ran = register_world.run(capsys, "register", str(study))
    assert ran.code == Exit.DONE, ran.err

    def get(query: str) -> dict[str, Any]:
        event = json.loads((ROOT / "tests/events/http_get.json").read_text())
        event["rawQueryString"] = query
        return next_step.handler(event, None)

    reply = get("projectId=ms-pacman&userId=ada")
    assert reply["statusCode"] == 200
    assert b"Learning to play Ms. Pac-Man" in gzip.decompress(base64.b64decode(reply["body"]))

    task = "arn:aws:ecs:us-east-1:123456789012:task/hippodrome/0123456789abcdef0123456789abcdef"
    register_world.answer("ecs:RunTask", {"tasks": [{"taskArn": task}], "failures": []})
    start = {"projectId": "ms-pacman", "userId": "ada", "attempt": 1}
    assert start_server.handler(register_world.sqs_event("start", [start]), None) == {"batchItemFailures": []}
    (call,) = [call for call in register_world.calls if call.action == "ecs:RunTask"]
    told = {one["name"]: one["value"] for one in call.params["overrides"]["containerOverrides"][0]["environment"]}
    assert call.params["taskDefinition"] == register_world.project("ms-pacman").task_definition
    assert (told["SSL_FULLCHAIN"], told["SSL_PRIVKEY"]) == (
        "SSL/servers.example.org/fullchain.pem",
        "SSL/servers.example.org/privkey.pem",
    )
    assert call.params["startedBy"] == ids.server_name(ids.server_label("ms-pacman", "ada"), 1)


def test_a_study_without_a_game_needs_no_image(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    configure(
        folder,
        ("{1: consent, 2: game, 3: thanks}", "{1: consent, 2: thanks}"),
        ("trial:\n  game: ALE/MsPacman-v5\n", ""),
    )
    answer = register("--json").json
    assert (answer["image"], answer["taskDefinition"]) == (None, None)
    assert register_world.project().task_definition is None
    assert (register_world.builds, register_world.image_tags(), register_world.revisions()) == ([], [], [])


# --- again --------------------------------------------------------------------------------------------------------


def test_register_without_changes_does_nothing(register_world: RegisterWorld, register: Register) -> None:
    register()
    before = bodies(register_world)
    salt = register_world.project().salt
    with register_world.recording() as calls:
        answer = register("--json").json
    writes = {"s3:DeleteObject", "ecs:RegisterTaskDefinition", "ecr:PutImage"}
    assert not writes & {call.action for call in calls}
    assert not [call for call in calls if call.action == "s3:PutObject" and "/steps/" in call.params["Key"]]
    assert answer["pages"] == {"uploaded": 0, "same": 3, "removed": 0}
    assert answer["imageBuilt"] is False
    assert len(register_world.revisions()) == 1
    assert bodies(register_world) == before
    assert register_world.project().salt == salt != ""


def test_only_the_changed_page_is_uploaded(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    register()
    (folder / "steps/consent.html").write_text("<p>May we?</p>")
    with register_world.recording() as calls:
        register()
    put = [call.params["Key"] for call in calls if call.action == "s3:PutObject"]
    assert [key for key in put if key.startswith("maze/")] == ["maze/steps/consent.html"]
    assert register_world.get("maze/steps/consent.html") == b"<p>May we?</p>"
    assert len(register_world.builds) == 1


def test_a_live_study_keeps_its_pages_until_its_new_image_exists(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    register(code=Exit.DONE)
    before = bodies(register_world)
    (folder / "steps/consent.html").write_text("<p>Another consent</p>")
    (folder / "agent.py").write_text("# another agent\n")
    register_world.fails = Problem("The packages could not be downloaded.")
    register(code=Exit.FAILED)
    assert bodies(register_world) == before


def test_a_page_whose_etag_is_no_md5_is_read(register_world: RegisterWorld, register: Register) -> None:
    """With a KMS key the ETag is no hash of the content, so the content itself is compared."""
    register()
    s3 = register_world.client("s3")
    listed = s3.list_objects_v2(Bucket=register_world.env["BUCKET"], Prefix="maze/steps/")["Contents"]
    lines = [{**line, "ETag": f'"{hashlib.md5(line["Key"].encode()).hexdigest()}"'} for line in listed]
    register_world.answer("s3:ListObjectsV2", {"Contents": lines, "IsTruncated": False})
    with register_world.recording() as calls:
        answer = register("--json").json
    assert answer["pages"]["same"] == 3
    assert [call.params["Key"] for call in calls if call.action == "s3:GetObject" and "/steps/" in call.params["Key"]]


def test_deleted_pages_are_removed_last(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    register()
    (folder / "steps/consent.html").unlink()
    for group in range(2):
        (folder / f"steps/consent-{group}.html").write_text(f"<p>{group}</p>")
    register_world.put("maze/users/ada/answers/1.json", b"{}")
    register_world.put("maze-two/steps/consent.html", b"another project's")
    register("--yes", code=Exit.DONE)
    assert register_world.keys("maze/steps/") == [
        f"maze/steps/{name}" for name in ("consent-0.html", "consent-1.html", "maze.png", "thanks.html")
    ]
    calls = [call for call in register_world.made if call in ("lambda:Invoke", "s3:DeleteObject")]
    assert calls == ["lambda:Invoke", "lambda:Invoke", "s3:DeleteObject"]
    assert register_world.get("maze-two/steps/consent.html") == b"another project's"
    assert register_world.get("maze/users/ada/answers/1.json") == b"{}"


def test_another_size_is_another_revision_of_the_same_image(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    register()
    configure(folder, ("memory: 2", "memory: 4"))
    register()
    assert len(register_world.builds) == 1
    assert [arn.rpartition(":")[2] for arn in register_world.revisions()] == ["1", "2"]
    assert register_world.project().task_definition == register_world.revisions()[1]


def test_pages_of_more_than_a_listing_are_registered(register_world: RegisterWorld, register: Register) -> None:
    """S3 lists 1,000 keys at a time; here a page has one key."""
    for name in ("a.txt", "b.txt", "c.txt"):
        register_world.put(f"maze/steps/{name}", b"x")
    s3 = register_world.client("s3")
    first = s3.list_objects_v2(Bucket=register_world.env["BUCKET"], Prefix="maze/steps/", MaxKeys=1)
    assert first["IsTruncated"]
    first.pop("ResponseMetadata")
    register_world.answer("s3:ListObjectsV2", first)
    answer = register("--json").json
    assert answer["pages"] == {"uploaded": 3, "same": 0, "removed": 3}
    assert len(register_world.keys("maze/steps/")) == 3


# --- open and closed ----------------------------------------------------------------------------------------------


def test_a_study_can_be_closed_and_opened_again(register_world: RegisterWorld, register: Register) -> None:
    register()
    known = register_world.project()
    ran = register("--no-live", code=Exit.DONE)
    assert not register_world.project().live
    assert register_world.project().task_definition == known.task_definition
    assert "closed" in ran.out
    assert register("--live", "--json").json["live"] is True
    assert register_world.project().live
    assert register_world.project().salt == known.salt != ""
    assert len(register_world.builds) == 1


def test_register_says_what_warm_servers_of_a_live_study_cost_a_day(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    configure(folder, ("maxRuntime: 30", "maxRuntime: 30\n  warmServers: 4"))
    said = "4 servers will be kept warm while the study is open: about $2.14 a day on Spot, $5.22 on demand"
    assert said in register().err.replace("\n", " ")
    assert "kept warm while" not in register("--no-live").err
    project = register_world.project()
    assert project is not None
    assert (project.live, project.warm_servers) == (False, 4)


def test_no_live_closes_the_study_first(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    register()
    (folder / "agent.py").write_text("class Agent:\n    new = True\n")
    register_world.fails, register_world.made = Problem("The packages could not be downloaded."), []
    ran = register("--no-live")
    assert ran.code == Exit.FAILED  # because the new image could not be built
    assert not register_world.project().live  # but no participant is admitted any more
    assert register_world.made.index("lambda:Invoke") == 2


@pytest.mark.parametrize("broken", ["steps: {1: consent", "maxRuntime: never"])
def test_a_study_is_closed_although_its_config_is_broken(
    register_world: RegisterWorld, folder: Path, broken: str, register: Register
) -> None:
    register()
    where = "steps: {1: consent" if broken.startswith("steps") else "maxRuntime: 30"
    (folder / "config.yml").write_text(CONFIG.replace(where, broken.replace("consent", "nosuchpage")))
    ran = register("--no-live", code=Exit.FAILED)
    assert "config.yml:" in ran.err
    assert not register_world.project().live


def test_closing_a_study_changes_nothing_else(register_world: RegisterWorld, folder: Path, register: Register) -> None:
    """Values that records leave out because they are the default, such as 1 vCPU and 2 GB, stay as well."""
    write_study(folder, steps__consent_DOT_html="x")
    configure(
        folder,
        (
            "  name: A maze\n",
            "  name: A maze\n  teamMembers: [Ada]\n  allowedHosts: [https://a.example]\n  cluster: participant\n",
        ),
        ("trial:\n", "trial:\n  options: {a: [1, {b: null}]}\n  ui: {good: true}\n"),
    )
    register()
    before = register_world.project()
    (folder / "config.yml").write_text("project:\n  id: maze\n")
    register("--no-live")
    after = register_world.project()
    assert not after.live
    import msgspec

    assert msgspec.structs.replace(after, live=True, version=before.version) == before


def test_a_new_study_can_be_registered_as_closed(register_world: RegisterWorld, register: Register) -> None:
    register("--no-live", code=Exit.DONE)
    assert register_world.project().live is False


def test_steps_of_a_study_with_participants_change_only_after_a_yes(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    register()
    register_world.put("maze/users/ada/participant.json", b"{}")
    (folder / "steps/survey.html").write_text("<p>?</p>")
    configure(folder, ("3: thanks", "3: survey, 4: thanks"))
    before = register_world.project()
    ran = register(code=Exit.DECLINED)
    assert "step 3 is survey (was thanks), step 4 is thanks (new)" in " ".join((ran.out + ran.err).split())
    assert register_world.project() == before
    assert "maze/steps/survey.html" not in register_world.keys("maze/steps/")
    register("--yes", code=Exit.DONE)
    assert [step.page for step in register_world.project().steps] == ["consent", "game", "survey", "thanks"]


def test_a_copied_folder_replaces_a_study_with_participants_only_after_a_yes(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    """Otherwise the other study's participants would get these pages and this agent."""
    register(code=Exit.DONE)
    configure(folder, ("A maze", "A second study"))
    assert register().code == Exit.DONE, "nobody has taken part yet"
    configure(folder, ("A maze", "A third study"))
    register_world.put("maze/users/ada/participant.json", b"{}")
    before = register_world.project()
    ran = register(code=Exit.DECLINED)
    assert "is called A second study, and this one A third study" in ran.err
    assert register_world.project() == before
    register("--yes", code=Exit.DONE)
    assert register_world.project().name == "A third study"


# --- only looking -------------------------------------------------------------------------------------------------


def test_a_dry_run_shows_every_change_and_makes_none(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    steps = register("--dry-run", "--json").json["steps"]
    assert [step.split()[0] for step in steps] == ["upload", "upload", "upload", "build", "make", "register"]
    assert register_world.keys() == []
    assert (register_world.builds, register_world.revisions()) == ([], [])
    register()
    ran = register("--dry-run")
    assert (ran.code, "Nothing to do" in ran.out) == (Exit.DONE, True)
    (folder / "steps/maze.png").unlink()
    before = (register_world.keys(), register_world.project())
    ran = register("--dry-run", "--no-live", code=Exit.CHANGES)
    assert "remove maze/steps/maze.png" in ran.out
    assert "new version" in ran.out
    assert (register_world.keys(), register_world.project()) == before


# --- the link -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "magic"), [("a.svg", b"<?xml"), ("a.PNG", b"\x89PNG"), ("a.pdf", b"%PDF")])
def test_the_qr_code_can_be_written_to_a_file(tmp_path: Path, name: str, magic: bytes, register: Register) -> None:
    register("--qr", str(tmp_path / name), code=Exit.DONE)
    assert (tmp_path / name).read_bytes().startswith(magic)


@pytest.mark.parametrize("name", ["poster.docx", "nowhere/poster.svg"])
def test_a_qr_code_that_cannot_be_written_stops_register_beforehand(
    register_world: RegisterWorld, folder: Path, name: str, register: Register
) -> None:
    register("--qr", str(folder / name), code=Exit.FAILED)
    assert register_world.made == []


def test_on_a_terminal_the_qr_code_is_shown(monkeypatch: pytest.MonkeyPatch, register: Register) -> None:
    monkeypatch.setattr("hippodrome.deployment.study.register.sys.stdout.isatty", lambda: True, raising=False)
    ran = register()
    assert re.search("[▀▄█]{4}", ran.out)


def test_for_signed_links_register_shows_no_link_without_a_signature(
    register_world: RegisterWorld, folder: Path, capsys: Capsys, monkeypatch: pytest.MonkeyPatch, register: Register
) -> None:
    monkeypatch.setattr("hippodrome.deployment.study.register.sys.stdout.isatty", lambda: True, raising=False)
    configure(folder, ("maxRuntime: 30", "signedLinks: true"))
    answer = register("--json").json
    assert (answer["signedLinks"], answer["link"]) == (True, None)
    ran = register()
    assert "/next?" not in ran.out
    assert not re.search("[▀▄█]", ran.out)
    assert "hippodrome links maze --new 50" in ran.out
    made = register_world.run(capsys, "links", "maze", "--new", "50")
    assert made.out.count("&signature=") == 50


def test_a_study_with_signed_links_has_no_qr_code(
    register_world: RegisterWorld, folder: Path, register: Register
) -> None:
    configure(folder, ("maxRuntime: 30", "signedLinks: true"))
    ran = register("--qr", str(folder.parent / "a.svg"), code=Exit.FAILED)
    assert "each participant has a link of their own" in ran.err
    assert register_world.made == []
    closed = register("--no-live", "--qr", str(folder.parent / "a.svg"), code=Exit.DONE)
    assert "each participant has a link of their own" in closed.err
    assert not (folder.parent / "a.svg").exists()


def test_recruiting_md_shows_the_form_of_the_link() -> None:
    text = (ROOT / "docs/recruiting.md").read_text()
    assert "https://…/next?projectId=your-project" in text


def test_the_documented_options_exist(register_world: RegisterWorld, capsys: Capsys) -> None:
    shown = register_world.run(capsys, "register", "--help").out
    for option in re.findall(r"`(--[a-z-]+)", (ROOT / "docs/aws-project.md").read_text()):
        assert option in shown
