"""`doctor` names unreadable documents of an installation with a remedy, and the other commands go on without them."""

from __future__ import annotations

import json
from typing import Any

import msgspec
import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.model import ids, server
from hippodrome.control.model.project import MASTER_LIST, Project, step_key
from hippodrome.control.storage.secret import KEY, SecretCache
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.core.finding import Finding, Mark, examine
from hippodrome.deployment.operate.doctor import documents
from testing.studies import PAGES, study
from tests.deployment.installation import Installed
from tests.deployment.operate.test_doctor import context

USER = "R_3fGxW2vPqT9aBcD"
CHECKS = {"documents": documents.documents, "pages": documents.step_pages}


@pytest.fixture
def world(installed: Installed) -> Installed:
    prepare(installed, study())
    return installed


def prepare(world: Installed, *projects: Project) -> None:
    world.register(*projects)
    for project in projects:
        for file, source in PAGES.items():
            world.put(step_key(project.id, file), source.encode())


def add_broken_entry(world: Installed) -> None:
    """Add an entry to the list of projects, in the form of HIPPO's, that lacks a step."""
    listed = json.loads(world.get(MASTER_LIST))
    listed["projects"].append({"id": "broken", "live": True, "steps": {"2": "consent.html"}})
    world.put(MASTER_LIST, json.dumps(listed).encode())


def findings_of(account: Account) -> list[Finding]:
    """Return the findings of doctor that are not good.

    Checks that each has a remedy and none holds the participant's id.
    """
    findings = [one for one in examine(context(account), CHECKS) if one.mark is not Mark.GOOD]
    assert not any(USER in one.text + one.advice for one in findings)
    assert all(one.advice for one in findings)
    return findings


def test_doctor_says_that_all_documents_can_be_read(world: Installed, account: Account) -> None:
    world.participant(USER, answered=2)
    world.record(USER)
    lines = [(one.mark, one.check) for one in examine(context(account), CHECKS)]
    assert lines == [(Mark.GOOD, "documents"), (Mark.GOOD, "pages")]


def test_doctor_names_an_unreadable_entry_of_the_list_of_projects(
    world: Installed, account: Account, capsys: Any
) -> None:
    add_broken_entry(world)
    (line,) = findings_of(account)
    assert (line.mark, line.check) == (Mark.BAD, "project broken")
    assert "counts as closed" in line.text
    assert "Register it again" in line.advice
    assert capsys.readouterr().err == "", "doctor prints a line and no warning besides"


def test_doctor_looks_for_the_pages_of_an_entry_that_hippo_wrote(world: Installed, account: Account) -> None:
    listed = json.loads(world.get(MASTER_LIST))
    listed["projects"].append({"id": "theirs", "live": True, "steps": {"1": "consent.html", "finalStep": "bye.html"}})
    world.put(MASTER_LIST, json.dumps(listed).encode())
    SecretCache(world.platform.documents).get_or_create()
    world.put(step_key("theirs", "consent", ""), b"<p>")
    (line,) = findings_of(account)
    assert (line.mark, line.check, line.text) == (Mark.BAD, "project theirs", "Step finalStep: bye.html is missing.")


def test_doctor_names_the_missing_secret(installed: Installed, account: Account) -> None:
    prepare(installed, study())
    installed.platform.documents.delete(KEY)
    (line,) = findings_of(account)
    assert (line.mark, line.check, line.text) == (
        Mark.BAD,
        "secret",
        "_secret.json is gone: pages answer with an error.",
    )
    SecretCache(installed.platform.documents).get_or_create()
    assert findings_of(account) == []


def test_doctor_names_an_unreadable_record_of_a_server(world: Installed, account: Account) -> None:
    label = ids.server_label("maze", USER)
    world.put(server.key(label), b"{")
    (line,) = findings_of(account)
    assert (line.mark, line.check) == (Mark.BAD, "servers")
    assert server.key(label) in line.text


@pytest.mark.parametrize("key", ["_slots/maze.json", "maze/slots/3.json"])
def test_doctor_names_unreadable_slots(world: Installed, account: Account, key: str) -> None:
    world.register(study(max_servers=4, max_participants=16))
    world.put(key, b"[")
    (line,) = findings_of(account)
    assert (line.mark, line.check, line.text.startswith(f"{key} cannot be read")) == (Mark.BAD, "project maze", True)


@pytest.mark.parametrize(
    ("source", "mark", "says"),
    [
        (b"{% if %}", Mark.BAD, "survey.html (line 1) cannot be shown"),
        (b"<p>\n{{ 1 / 0 }}", Mark.BAD, "survey.html (line 2) cannot be shown"),
        (b"{{ 1 / (answers['2'].age | int) }}", Mark.LOOK, "fails for a participant without answers"),
    ],
)
def test_doctor_names_a_page_that_does_not_render(
    world: Installed, account: Account, source: bytes, mark: Mark, says: str
) -> None:
    world.put(step_key("maze", "survey"), source)
    (line,) = findings_of(account)
    assert (line.mark, line.check) == (mark, "project maze")
    assert says in line.text


def test_doctor_names_a_page_that_is_missing(world: Installed, account: Account) -> None:
    world.client("s3").delete_object(Bucket=world.env["BUCKET"], Key=step_key("maze", "consent-1"))
    (line,) = findings_of(account)
    assert (line.mark, line.text) == (Mark.BAD, "Step 1: consent-1.html is missing.")


def test_doctor_names_the_problems_of_every_project(world: Installed, account: Account) -> None:
    prepare(world, study(), msgspec.structs.replace(study(), id="other"))
    add_broken_entry(world)
    world.put(step_key("maze", "survey"), b"{% if %}")
    world.put(step_key("other", "survey"), b"{% if %}")
    assert [one.check for one in findings_of(account)] == ["project broken", "project maze", "project other"]


# Other commands


def test_status_names_unreadable_documents_and_goes_on(world: Installed, capsys: Any) -> None:
    add_broken_entry(world)
    world.participant(USER)
    world.put(server.key(ids.server_label("maze", "bob")), b"{")
    ran = world.run(capsys, "status", "--all", "--json")
    assert ran.code == Exit.DONE
    assert [(one["id"], one["participants"]) for one in ran.json["projects"]] == [("maze", 1)]
    problems = ran.json["problems"]
    assert "counts as closed" in problems["project broken"]
    assert problems["records of servers"].startswith("1 record cannot be read")
    assert "No project broken: The entry of" in " ".join(world.run(capsys, "status", "--all").out.split())


def test_stop_names_unreadable_documents_and_goes_on(world: Installed, capsys: Any) -> None:
    add_broken_entry(world)
    world.record(USER)
    world.put(server.key(ids.server_label("maze", "bob")), b"{")
    ran = world.run(capsys, "stop", "--all", "--yes", "--json")
    assert (ran.code, ran.json["stopped"]) == (Exit.DONE, 1)
    assert "The entry of the project broken" in " ".join(ran.err.split())
    assert "1 record of servers cannot be read" in " ".join(ran.err.split())


def test_erase_names_unreadable_documents_and_goes_on(
    world: Installed, capsys: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # the receipt is written into the current folder
    add_broken_entry(world)
    world.register(study(max_participants=16))
    world.participant(USER, answered=2)
    world.put("maze/slots/3.json", f'["{ids.server_label("maze", USER)}'.encode())
    world.put("maze/slots/4.json", b"[")  # names nobody
    ran = world.run(capsys, "erase", USER, "maze", "--yes")
    assert ran.code == Exit.DONE, ran.err
    assert not [key for key in world.keys("maze/users/") if USER in key]
    assert "maze/slots/3.json in hippodrome cannot be read" in " ".join(ran.err.split())
    assert "Everything that can be read is gone" in ran.err
    assert "maze/slots/4.json" not in ran.err


@pytest.mark.parametrize(("project", "warned"), [("maze", False), ("broken", True)])
def test_data_names_unreadable_entries_of_its_own_project_alone(
    world: Installed, capsys: Any, tmp_path: Any, project: str, warned: bool
) -> None:
    add_broken_entry(world)
    world.participant(USER, answered=2)
    world.participant(USER, answered=2, project=study(id="broken"))
    ran = world.run(capsys, "data", project, "--to", str(tmp_path / "out"))
    assert ran.code == Exit.DONE, ran.err
    assert USER in (tmp_path / "out" / "answers.csv").read_text()
    assert ("cannot be read" in ran.err) is warned
