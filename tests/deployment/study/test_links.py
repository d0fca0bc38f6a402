"""`hippodrome links`: the links that it prints open the study, and changed ones do not."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.model import ids
from hippodrome.control.model.project import MASTER_LIST
from hippodrome.control.storage.secret import SecretCache
from hippodrome.deployment.study import links
from hippodrome.functions import update_project_master_list
from testing.studies import PAGES, SECRET, study
from testing.visitors import Browser
from tests.deployment.installation import CommandResult
from tests.deployment.registering import RegisterWorld

SIGNED = msgspec.structs.replace(study(), signed_links=True)


@pytest.fixture
def world(register_world: RegisterWorld) -> RegisterWorld:
    register_world.register(SIGNED, msgspec.structs.replace(study(), id="open"))
    for file, source in PAGES.items():
        register_world.put(f"maze/steps/{file}.html", source.encode())
    return register_world


def run(world: RegisterWorld, capsys: Any, *more: str, project: str = "maze") -> CommandResult:
    return world.run(capsys, "links", project, *more)


def test_each_line_is_the_link_of_one_participant(world: RegisterWorld, capsys: Any, tmp_path: Path) -> None:
    file = tmp_path / "ids.txt"
    file.write_text("\ufeffann\n\n  bob \nann\n", encoding="utf-8")
    ran = run(world, capsys, "--ids", str(file))
    assert ran.code == Exit.DONE
    rows = list(csv.DictReader(io.StringIO(ran.out)))
    assert [row["userId"] for row in rows] == ["ann", "bob"]
    for row in rows:
        site, _, query = row["link"].partition("/next?")
        assert site.startswith("https://")
        browser: Any = Browser(world.platform, query)
        assert "agree" in browser.get() or "May we" in browser.get()
        browser.query = query.replace(row["userId"], "carol")
        assert browser.send()["statusCode"] == 403


def test_new_ids_are_all_different(world: RegisterWorld, capsys: Any) -> None:
    found = run(world, capsys, "--new", "20", "--json").json
    assert len({one["userId"] for one in found}) == 20
    assert all(one["userId"] in one["link"] for one in found)


@pytest.mark.parametrize("text", ["ann@example.org\n", "userId,link\n", "a b\n", "x" * 65])
def test_an_invalid_id_is_reported_with_its_line(world: RegisterWorld, capsys: Any, tmp_path: Path, text: str) -> None:
    (tmp_path / "ids.txt").write_text(f"ann\n{text}")
    ran = run(world, capsys, "--ids", str(tmp_path / "ids.txt"))
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "ids.txt:2" in ran.err
    assert text.strip() not in ran.err


@pytest.mark.parametrize(
    "heading",
    [
        "PROLIFIC_PID",
        "participant",
        "Participant id",
        "userId",
        "workerid",
        "id",
        "PID",
        "sona_id",
        "SubjectID",
        "Code",
    ],
)
def test_a_heading_is_not_invited_and_the_researcher_is_told(
    world: RegisterWorld, capsys: Any, tmp_path: Path, heading: str
) -> None:
    (tmp_path / "ids.csv").write_text(f"{heading}\r\nP01\r\n")
    ran = run(world, capsys, "--ids", str(tmp_path / "ids.csv"), "--json")
    assert [one["userId"] for one in ran.json] == ["P01"]
    assert "ids.csv:1: this line is taken as the heading" in " ".join(ran.err.split())


@pytest.mark.parametrize("first", ["david", "ann", "P01", "5f3c", "astrid", "userid7"])
def test_an_id_in_the_first_line_is_no_heading(world: RegisterWorld, capsys: Any, tmp_path: Path, first: str) -> None:
    (tmp_path / "ids.csv").write_text(f"{first}\nP02\n")
    ran = run(world, capsys, "--ids", str(tmp_path / "ids.csv"), "--json")
    assert [one["userId"] for one in ran.json] == [first, "P02"]


@pytest.mark.parametrize(
    "data",
    [
        "\ufeffP01\r\nP02\r\n".encode("utf-16-le"),
        "\ufeffP01\nP02".encode("utf-16-be"),
        b'"P01"\n"P02"\n',
        b"P01,\nP02,\n",
        b";P01;;\nP02\n",
        "P01\u00a0\nP02\u200b\n".encode(),
        b"P01\rP02\r",
        b"\n\nP01\t\nP01\nP02\n",
    ],
)
def test_ids_are_read_as_spreadsheets_write_them(
    world: RegisterWorld, capsys: Any, tmp_path: Path, data: bytes
) -> None:
    (tmp_path / "ids.csv").write_bytes(data)
    ran = run(world, capsys, "--ids", str(tmp_path / "ids.csv"), "--json")
    assert [one["userId"] for one in ran.json] == ["P01", "P02"]


def test_ids_from_stdin_may_begin_with_a_byte_order_mark(
    world: RegisterWorld, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"\xef\xbb\xbfP01\n")))
    assert [one["userId"] for one in run(world, capsys, "--ids", "-", "--json").json] == ["P01"]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("P02;1", "there is more than an id. → Keep only the column with the ids."),
        ("P02,group a", "there is more than an id."),
        ("5.99E+23", "a spreadsheet has made a number of this id."),
        ("5,99E+23", "there is more than an id."),
        ("1001.0", "a spreadsheet has made a number of this id."),
        ("participant id", "that is no participant's id."),
    ],
)
def test_a_line_with_more_or_less_than_an_id_is_refused(
    world: RegisterWorld, capsys: Any, tmp_path: Path, line: str, said: str
) -> None:
    (tmp_path / "ids.csv").write_text(f"P01\n{line}\n")
    ran = run(world, capsys, "--ids", str(tmp_path / "ids.csv"))
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert f"ids.csv:2: {said}" in " ".join(ran.err.split())


def test_links_needs_participants_and_a_known_project_and_says_if_links_are_not_signed(
    world: RegisterWorld, capsys: Any, tmp_path: Path
) -> None:
    assert run(world, capsys).code == Exit.FAILED
    assert run(world, capsys, "--ids", str(tmp_path / "none.txt")).code == Exit.FAILED
    assert "No project named" in run(world, capsys, "--new", "1", project="other").err
    ran = run(world, capsys, "--new", "1", project="open")
    assert (ran.code, "signedLinks" in ran.err) == (Exit.DONE, True)


def test_links_are_made_without_reading_the_secret(world: RegisterWorld, capsys: Any) -> None:
    SecretCache(world.platform.documents).get_or_create()
    world.register(SIGNED)
    world.asked.clear()
    (made,) = run(world, capsys, "--new", "1", "--json").json
    assert [told["Key"] for action, told in world.asked if action == "s3:GetObject"] == [MASTER_LIST]
    browser: Any = Browser(world.platform, made["link"].partition("?")[2])  # type: ignore[arg-type]
    assert browser.send()["statusCode"] == 200


def test_many_links_are_requested_in_several_messages(
    world: RegisterWorld, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(links, "MAX_SIGNED", 3)
    found = run(world, capsys, "--new", "7", "--json").json
    assert world.made.count("lambda:Invoke") == 3
    for one in found:
        assert one["link"].endswith(f"&signature={ids.link_signature(SECRET, 'maze', one['userId'])}")


def test_if_the_function_signs_no_links_its_reason_is_shown(
    world: RegisterWorld, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(update_project_master_list, "handler", lambda *_: {"problems": ["links: no project"]})
    ran = run(world, capsys, "--new", "1")
    assert (ran.code, "links: no project" in ran.err) == (Exit.FAILED, True)
