"""From the project folder to the documents, and what the terminal tells."""

from __future__ import annotations

import io
import json
import unicodedata
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import installed
from hippodrome.local import publish
from hippodrome.local.activity.log import ActivityLog
from hippodrome.local.backend.platform import LocalPlatform
from tests.local.conftest import write_study


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_study(tmp_path / "study")


@pytest.fixture
def platform(tmp_path: Path) -> Iterator[LocalPlatform]:
    made = LocalPlatform(tmp_path / "data", tmp_path / "state", handlers={})
    installed.use(made)
    yield made
    made.close()


def _keys(platform: LocalPlatform) -> list[str]:
    return [entry.key for entry in platform.documents.list("")]


def test_publish_writes_pages_pictures_and_the_registration(folder: Path, platform: LocalPlatform) -> None:
    (folder / "steps" / "cat.png").write_bytes(b"\x89PNG")
    (folder / "steps" / ".DS_Store").write_bytes(b"?")
    (folder / "steps" / "folder").mkdir()
    publish.publish(folder, platform.documents)
    assert _keys(platform) == [
        "_secret.json",
        "project_master_list.json",
        *(f"quick/steps/{name}" for name in ("bye.html", "cat.png", "end.html", "hello.html")),
    ]
    [project] = json.loads((platform.documents.folder / "project_master_list.json").read_text())["projects"]
    assert project["id"] == "quick"


def test_a_file_from_a_mac_has_the_name_that_pages_write(folder: Path, platform: LocalPlatform) -> None:
    (folder / "steps" / unicodedata.normalize("NFD", "Übung.png")).touch()
    config = publish.publish(folder, platform.documents)
    assert platform.documents.get(f"{config.project.id}/steps/Übung.png") is not None


def test_publish_writes_only_changed_files(folder: Path, platform: LocalPlatform) -> None:
    publish.publish(folder, platform.documents)
    pages = platform.documents.folder / "quick" / "steps"
    before = {path.name: path.stat().st_ino for path in pages.iterdir()}
    (folder / "steps" / "bye.html").write_text("<h1>other</h1>")
    publish.publish(folder, platform.documents)
    after = {path.name: path.stat().st_ino for path in pages.iterdir()}
    assert {name for name in after if after[name] != before[name]} == {"bye.html"}


def test_the_secret_stays_when_it_is_published_again(folder: Path, platform: LocalPlatform) -> None:
    def secret() -> str:
        found = ProjectCache(platform, SecretCache(platform.documents)).project("quick")
        assert found
        return found.secret

    publish.publish(folder, platform.documents)
    first = secret()
    config = folder / "config.yml"
    config.write_text(config.read_text().replace("A quick study", "Another name"))
    publish.publish(folder, platform.documents)
    assert (secret(), len(first)) == (first, 64)


def test_a_project_for_aws_can_run_on_this_machine(folder: Path, platform: LocalPlatform) -> None:
    config = folder / "config.yml"
    setup = (
        "  useAWS: true\n  awsSetup: "
        "{bucket: my-studies, region: ca-central-1, rootDomain: play.example.org, cpu: 1, memory: 2}\n"
    )
    config.write_text(config.read_text().replace("  maxRuntime", f"{setup}  maxRuntime"))
    assert publish.publish(folder, platform.documents).project.use_aws


def test_changed_steps_are_reported_if_participants_have_begun(folder: Path, platform: LocalPlatform) -> None:
    config, said = folder / "config.yml", list[str]()
    with_two = config.read_text()
    with_three = with_two.replace("{1: hello, 2: game, 3: bye,", "{1: hello, 2: bye, 3: game, 4: bye,")
    with_three = with_three.replace("stopServerStep: 3", "stopServerStep: 4")
    for begun in (False, True):
        for text in (with_three, with_two, with_two + "\n"):
            config.write_text(text)
            publish.publish(folder, platform.documents, say=said.append)
        if not begun:
            assert said == []
            platform.documents.create("quick/users/5f2a/participant.json", b"{}")
    assert len(said) == 2, "a change that moves no page is no news"
    assert ": step 2 is bye (was game), step 3 is game (was bye), step 4 is bye (new). " in said[0]
    assert ": step 2 is game (was bye), step 3 is bye (was game), step 4 is gone (was bye). " in said[1]


def test_publish_reports_all_mistakes(folder: Path, platform: LocalPlatform) -> None:
    config = folder / "config.yml"
    config.write_text(config.read_text().replace("1: hello", "1: nowhere").replace("maxEpisodes: 1", "maxEpisodes: no"))
    with pytest.raises(publish.NotPublished) as found:
        publish.publish(folder, platform.documents)
    assert len(found.value.problems) == 2
    assert _keys(platform) == []


def _activity_log() -> tuple[ActivityLog, io.StringIO]:
    text = io.StringIO()
    return ActivityLog(Console(file=text, highlight=False, soft_wrap=True)), text


def test_the_terminal_shortens_ids_and_shows_no_answers() -> None:
    activity_log, text = _activity_log()
    activity_log.set_steps("study", ["1", "2", "finalStep"])
    folder = "study/users/5f2a9bc01d7e"
    activity_log.wrote(f"{folder}/participant.json", b'{"group": 1, "completionCode": "SECRET"}')
    activity_log.wrote(f"{folder}/answers/2.json", b'{"step": "2", "page": "survey-1", "answers": {"x": "SECRET"}}')
    activity_log.wrote(f"{folder}/answers/2.json", b'{"step": "2", "page": "survey-1", "answers": {"x": "SECRET"}}')
    activity_log.wrote(f"{folder}/trials/x.json", b"SECRET")
    activity_log.wrote("study/steps/a.html", b"SECRET")
    lines = [line[10:].strip() for line in text.getvalue().splitlines()]
    assert lines == [
        "5f2a9b…  arrived, group 1",
        "5f2a9b…  answered step 2 (survey-1)",
        "5f2a9b…  came to the end of the study",
    ]


@pytest.mark.parametrize(
    ("user", "shown"), [("P1", "P1"), ("123456", "123456"), ("1234567", "123456…"), ("12345678", "123456…")]
)
def test_the_terminal_shows_at_most_six_characters_of_an_id(user: str, shown: str) -> None:
    activity_log, text = _activity_log()
    activity_log.participant(user, "arrived")
    assert text.getvalue().split()[1] == shown


def test_the_terminal_shows_the_states_of_a_server() -> None:
    activity_log, text = _activity_log()
    record = {"projectId": "p", "userId": "P1", "attempt": 1, "nonce": "n", "host": "127.0.0.1", "port": 5}
    for state in ("starting", "starting", "naming", "ready", "closed"):
        activity_log.wrote("_servers/s.json", json.dumps({**record, "state": state, "reason": "ended"}).encode())
    activity_log.wrote("_servers/s.json", json.dumps({**record, "state": "starting", "attempt": 2}).encode())
    lines = [line[10:].strip() for line in text.getvalue().splitlines()]
    assert lines == [
        "P1       server starting",
        "P1       server ready at ws://127.0.0.1:5",
        "P1       server gone (the trial ended)",
        "P1       server starting, attempt 2",
    ]


def test_a_game_that_starts_again_is_printed_if_it_may_differ(tmp_path: Path) -> None:
    log = tmp_path / "s-2.log"
    log.write_text("")
    task = SimpleNamespace(name="s-2", folder="study/users/P1")
    activity_log, text = _activity_log()
    tasks = SimpleNamespace(playing=lambda: [task], log=lambda _name: log)
    activity_log.follow(tasks, tmp_path)  # type: ignore[arg-type]
    log.write_text(
        "2026-01-01 10:00:00,100 WARNING the episode cannot go on where it was and begins again (Diverged)\n"
    )
    activity_log.close()
    [line] = text.getvalue().splitlines()
    assert line[10:].startswith("P1 ")
    assert "begins anew: something in agent.py is left to chance (docs/agent.md)" in line


def test_a_server_that_was_stopped_before_its_start_is_not_printed() -> None:
    activity_log, text = _activity_log()
    record = {"projectId": "p", "userId": "P1", "attempt": 1, "state": "closed", "reason": "stopped"}
    activity_log.wrote("_servers/s.json", json.dumps(record).encode())
    assert text.getvalue() == ""


@pytest.mark.parametrize("body", [b"", b"[]", b"\xff", b'{"userId": 1}', b'{"state": "ready", "attempt": "x"}'])
def test_a_closed_terminal_does_not_stop_the_study(body: bytes) -> None:
    activity_log, text = _activity_log()
    for key in ("_servers/s.json", "p/users/u/answers/1.json", "p/users/u/participant.json", "x"):
        activity_log.wrote(key, body)
    text.close()
    activity_log.say("nobody reads this any more")
