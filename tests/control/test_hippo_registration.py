"""update_project_master_list accepts what HIPPO's updateProject.py sends, and answers in the form that it reads."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import msgspec
import pytest

from hippodrome.control.model.project import MASTER_LIST, Project, read_list, step_key
from hippodrome.deployment.core.project_folder import registration_of
from hippodrome.functions import installed as place
from hippodrome.functions import next_step, update_project_master_list
from testing.aws_events import program_event
from testing.fake_platform import FakePlatform

PAYLOAD: dict[str, Any] = {
    "useAWS": True,
    "awsSetup": {"bucket": None, "region": None, "rootDomain": None, "cpu": 2, "memory": 10,
                 "containerName": "flight", "repository": "flight"},
    "events": {"startServerStep": 1, "stopServerStep": 12},
    "id": "flight", "live": True, "maxRuntime": 30, "name": "Flight", "researcher": "R",
    "ssl": {"fullchain": "SSL/fullchain.pem", "privkey": "SSL/privkey.pem", "sslBucket": None},
    "steps": {"1": "consent.html", "2": "game", "3": "thank.html", "finalStep": "thank.html"},
    "teamMembers": "T", "ecsTask": "flight", "bucket": None,
}  # fmt: skip


@pytest.fixture
def platform() -> FakePlatform:
    place.use(platform := FakePlatform())
    for file in ("consent", "thank"):
        platform.documents.put(step_key("flight", file), b"<p>")
    return platform


def test_the_scripts_project_is_registered_with_remarks(platform: FakePlatform) -> None:
    answer = update_project_master_list.handler(PAYLOAD, None)
    assert answer["statusCode"] == 200, answer
    assert all(word in answer["body"] for word in ("ecsTask", "containerName", "stopServerStep", "trial"))
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert [step.key for step in project.steps] == ["1", "2", "3"]
    assert (project.live, project.max_runtime, project.events.stop_server_step) == (True, 30, "3")


@pytest.mark.parametrize("change", [
    {"steps": {"1": "nowhere.html"}}, {"steps": {"1": ["a"]}}, {"steps": {"1": {"2": "a"}}}, {"steps": {}}, {"steps": 7},
    {"id": "../x"}, {"id": None}, {"id": {}}, {"steps": {"1": "x" * 300_000}}, {"events": []}, {"awsSetup": "a"},
])  # fmt: skip
def test_a_project_that_cannot_be_registered_gets_a_sentence(platform: FakePlatform, change: dict[str, Any]) -> None:
    answer = update_project_master_list.handler({**PAYLOAD, **change}, None)
    assert answer["statusCode"] == 400
    assert 0 < len(answer["body"]) < 2_000
    assert MASTER_LIST not in platform.documents.kept


def test_the_game_of_an_earlier_registration_stays(platform: FakePlatform) -> None:
    ours = {k: v for k, v in PAYLOAD.items() if k in ("id", "live", "awsSetup", "useAWS")}
    ours["awsSetup"] = {"cpu": 1, "memory": 2}
    steps = [{"key": "1", "page": "consent"}, {"key": "2", "page": "game"}, {"key": "3", "page": "thank"}]
    event = {"project": {**ours, "steps": steps, "trial": {"game": "CartPole-v1"}, "taskDefinition": "t:1"}}
    assert update_project_master_list.handler(event, None) == {"registered": "flight", "live": True, "steps": 3}
    assert update_project_master_list.handler(PAYLOAD, None)["statusCode"] == 200
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert (project.trial["game"], project.task_definition) == ("CartPole-v1", "t:1")


def test_pages_of_a_list_that_hippo_wrote_are_shown_once_any_project_is_registered(platform: FakePlatform) -> None:
    for file in ("consent", "thank"):
        platform.documents.put(f"flight/{file}.html", b"<p>as uploaded")
        platform.documents.put(step_key("other", file), b"<p>")
    platform.documents.put(MASTER_LIST, json.dumps({"projects": [PAYLOAD]}).encode())
    assert update_project_master_list.handler({**PAYLOAD, "id": "other"}, None)["statusCode"] == 200
    assert "as uploaded" in first_page("u1")


OURS = {"signedLinks": True, "maxParticipants": 5, "maxServers": 3, "maxServerHours": 20, "cluster": "participant",
        "allowedHosts": ["https://x.example.org"]}  # fmt: skip


@pytest.mark.parametrize("given", ["flight", "a b"])
def test_the_script_neither_opens_a_study_by_invitation_nor_lifts_its_limits(
    platform: FakePlatform, given: str
) -> None:
    project_id = given.replace(" ", "-")
    for file in ("consent", "thank"):
        platform.documents.put(step_key(project_id, file), b"<p>")
    steps = [{"key": "1", "page": "consent"}, {"key": "2", "page": "game"}, {"key": "3", "page": "thank"}]
    ours = {"id": project_id, "live": True, "steps": steps, "trial": {"game": "CartPole-v1"}, "taskDefinition": "t:1"}
    assert "registered" in update_project_master_list.handler({"project": ours | OURS}, None)
    for _ in range(2):
        answer = update_project_master_list.handler({**PAYLOAD, "id": given}, None)
        assert answer["statusCode"] == 200, answer
        assert "project.signedLinks: true stays, as it was registered before" in answer["body"]
        (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
        assert {key: msgspec.to_builtins(project).get(key) for key in OURS} == OURS
        assert (project.id, project.task_definition, project.trial["game"]) == (project_id, "t:1", "CartPole-v1")


def test_the_studys_own_texts_stay(platform: FakePlatform) -> None:
    texts = {"language": "de", "start": "Los", "moved": "Das Spiel zieht um. " * 20}
    steps = [{"key": "1", "page": "consent"}, {"key": "2", "page": "game"}, {"key": "3", "page": "thank"}]
    ours = {"id": "flight", "live": True, "steps": steps, "trial": {"game": "CartPole-v1"}, "texts": texts}
    assert "registered" in update_project_master_list.handler({"project": ours}, None)
    answer = update_project_master_list.handler(PAYLOAD, None)
    assert answer["statusCode"] == 200, answer
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert project.texts == {name: text.strip() for name, text in texts.items()}
    (remark,) = [line for line in answer["body"].splitlines() if line.startswith("project.texts: ")]
    assert remark.startswith('project.texts: {"language": "de", ')
    assert len(remark) < 400
    assert "project.patience" not in answer["body"]  # it was never set


def test_keys_that_the_script_sends_itself_are_registered(platform: FakePlatform) -> None:
    assert registered(platform, signedLinks=True, maxServers=3).signed_links
    changed = registered(platform, signedLinks=False)
    assert (changed.signed_links, changed.max_servers) == (False, 3)


def registered(platform: FakePlatform, **changes: Any) -> Project:
    answer = update_project_master_list.handler({**PAYLOAD, **changes}, None)
    assert answer["statusCode"] == 200, answer
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    return project


def first_page(user: str) -> str:
    answer = next_step.handler(program_event("GET", {"projectId": "flight", "userId": user}), None)
    assert answer["statusCode"] == 200, answer
    return str(json.loads(answer["body"])["page"])


def test_pages_are_shown_from_where_the_script_uploads_them(platform: FakePlatform) -> None:
    for file in ("consent", "thank"):
        platform.documents.put(f"flight/{file}.html", b"<p>as uploaded")
    assert registered(platform).page_folder == ""
    assert "as uploaded" in first_page("u1")


def test_pages_of_an_earlier_make_register_are_shown_if_the_script_uploaded_none(platform: FakePlatform) -> None:
    assert registered(platform).page_folder == "steps"
    assert "<p>" in first_page("u1")


def test_numbered_pages_are_pages_of_groups(platform: FakePlatform) -> None:
    for file in ("consent-0", "consent-1", "thank", "consent-form"):
        platform.documents.put(f"flight/{file}.html", f"<p>page {file}".encode())
    assert [step.variants for step in registered(platform).steps] == [2, 0, 0]
    shown = {
        next(line for line in ("page consent-0", "page consent-1") if line in first_page(f"u{n}")) for n in range(30)
    }
    assert shown == {"page consent-0", "page consent-1"}


@pytest.mark.parametrize(
    ("files", "missing"),
    [
        (("consent-0", "consent-1", "consent-3", "thank"), "consent-2.html has not been uploaded"),
        (("consent", "consent-0", "consent-1", "thank"), "upload it as consent-2.html"),
        (("consent-1", "thank"), "consent.html has not been uploaded"),
    ],
)
def test_wrong_numbers_of_group_pages_get_a_sentence(
    platform: FakePlatform, files: tuple[str, ...], missing: str
) -> None:
    platform.documents.delete(step_key("flight", "consent"))
    for file in files:
        platform.documents.put(f"flight/{file}.html", b"<p>")
    answer = update_project_master_list.handler(PAYLOAD, None)
    assert answer["statusCode"] == 400
    assert missing in answer["body"]
    assert MASTER_LIST not in platform.documents.kept


def test_the_documents_of_participants_are_not_listed(platform: FakePlatform, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    usual = platform.documents.list
    monkeypatch.setattr(platform.documents, "list", lambda prefix: asked.append(prefix) or usual(prefix))
    for file in ("users", "thank"):
        platform.documents.put(f"flight/{file}.html", b"<p>")
    events = {"startServerStep": None, "stopServerStep": None}
    registered(platform, steps={"1": "users.html", "2": "thank.html"}, events=events)
    assert asked
    assert not [prefix for prefix in asked if "flight/users/".startswith(prefix)]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"awsSetup": {**PAYLOAD["awsSetup"], "region": "ca-central-1"}}, "awsSetup.region is ca-central-1, but"),
        ({"awsSetup": {**PAYLOAD["awsSetup"], "rootDomain": "irll.net"}}, "awsSetup.rootDomain is irll.net, but"),
        ({"awsSetup": {**PAYLOAD["awsSetup"], "bucket": "hippo-lab"}}, "awsSetup.bucket is hippo-lab, but"),
        ({"bucket": "hippo-lab"}, "awsSetup.bucket is hippo-lab, but"),
    ],
)
def test_a_study_for_another_installation_is_refused(
    platform: FakePlatform, changes: dict[str, Any], said: str
) -> None:
    here = {"bucket": "the-bucket", "region": "eu-central-1", "root_domain": "example.org"}
    platform.settings = replace(platform.settings, **here)
    answer = update_project_master_list.handler({**PAYLOAD, **changes}, None)
    assert answer["statusCode"] == 400
    assert said in answer["body"]
    assert MASTER_LIST not in platform.documents.kept
    same = {**PAYLOAD["awsSetup"], "bucket": "the-bucket", "region": "eu-central-1", "rootDomain": "Example.org"}
    assert (
        update_project_master_list.handler({**PAYLOAD, "awsSetup": same, "bucket": "the-bucket"}, None)["statusCode"]
        == 200
    )


@pytest.mark.parametrize(("given", "kept"), [(600, 120), ("600", 120), (5000, 120), (120, 120), (30, 30), (None, 60)])
def test_servers_run_no_longer_than_the_installation_allows(platform: FakePlatform, given: Any, kept: int) -> None:
    platform.settings = replace(platform.settings, max_runtime=120)
    answer = update_project_master_list.handler({**PAYLOAD, "maxRuntime": given}, None)
    (project,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert project.max_runtime == kept
    assert ("servers here are stopped after 120" in answer["body"]) is (str(given) in ("600", "5000"))


def test_remarks_are_in_the_log_since_the_script_does_not_print_them(
    platform: FakePlatform, caplog: pytest.LogCaptureFixture
) -> None:
    answer = update_project_master_list.handler(PAYLOAD, None)
    (line,) = [record for record in caplog.records if hasattr(record, "remarks")]
    assert "\n".join(line.remarks) == answer["body"]


def test_pages_that_were_uploaded_under_another_id_get_a_sentence(platform: FakePlatform) -> None:
    for file in ("consent", "thank"):
        platform.documents.put(f"a flight/{file}.html", b"<p>")
    answer = update_project_master_list.handler({**PAYLOAD, "id": "a flight"}, None)
    assert answer["statusCode"] == 400
    assert "write a-flight for both" in answer["body"]


def test_a_study_that_the_script_registered_can_be_closed_and_keeps_its_pages(platform: FakePlatform) -> None:
    for file in ("consent-0", "consent-1", "thank"):
        platform.documents.put(f"flight/{file}.html", b"<p>")
    before = registered(platform)
    answer = update_project_master_list.handler({"project": registration_of(before, live=False)}, None)
    assert answer == {"registered": "flight", "live": False, "steps": 3}
    (after,) = read_list(platform.documents.kept[MASTER_LIST][0]).projects
    assert (after.page_folder, after.steps) == ("", before.steps)


@pytest.mark.parametrize("folder", ["users", "../other", None, 7, []])
def test_the_folder_of_pages_is_steps_or_empty(platform: FakePlatform, folder: Any) -> None:
    ours = {**registration_of(registered(platform), live=True), "pageFolder": folder}
    (problem,) = update_project_master_list.handler({"project": ours}, None)["problems"]
    assert problem.startswith("pageFolder: must be steps")
