"""`doctor --rehearse --play`: bots walk through a copy of a study in a running installation; the transcript."""

from __future__ import annotations

import json
import os
import re
import signal
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import MappingProxyType
from typing import Any

import msgspec
import pytest
import yaml

from hippodrome.console.problem import Exit
from hippodrome.control.lobby import decisions
from hippodrome.control.lobby.decisions import Decisions, OpenSession
from hippodrome.control.model.balance import cells_key
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import MASTER_LIST, MasterList, UnreadableEntry, read_list, write_list
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import ServerState
from hippodrome.control.storage.project_cache import FRESH
from hippodrome.deployment.aws.account import find_installation
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.core.participants import registered_projects
from hippodrome.deployment.operate.doctor import play as rehearsal_with_bots
from hippodrome.deployment.operate.doctor import study_copy
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.operate.doctor.play import KILLED, Play
from hippodrome.deployment.operate.doctor.study_copy import StudyCopy, changed, left_behind, page_files, unregister
from hippodrome.deployment.operate.doctor.transcript import LINES, Transcript
from hippodrome.protocol.keys import session_key
from hippodrome.protocol.session import Member, SessionDocument
from testing.aws_events import ACCOUNT
from testing.fake_platform import FakePlatform
from testing.moto_world import MotoWorld
from testing.studies import study
from testing.waiting import until
from tests.deployment.installation import ROOT, CommandResult, Installed, account_here
from tests.deployment.running_installation import RunningInstallation, held
from tests.e2e.conftest import AGENT, CONFIG, PAGES
from tests.trial.two_players import two_players

STUDY = "tiny"


def write_study(
    folder: Path,
    *,
    agent: str = AGENT.format(start="pass", length=100_000),
    project: Mapping[str, Any] = MappingProxyType({}),
    trial: Mapping[str, Any] = MappingProxyType({}),
) -> Path:
    """Write a study for AWS whose game lasts longer than any bot plays."""
    (folder / "steps").mkdir(parents=True)
    on_aws = {"useAWS": True, "awsSetup": {"cpu": 0.5, "memory": 1}}
    config = {"project": {**CONFIG["project"], **on_aws, **project}, "trial": {**CONFIG["trial"], **trial}}
    (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False))
    (folder / "agent.py").write_text(agent)
    for name, text in PAGES.items():
        (folder / "steps" / f"{name}.html").write_text(text)
    return folder


@pytest.fixture
def running(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningInstallation]:
    """A running installation with one live study."""
    monkeypatch.setattr(study_copy, "FRESH", timedelta(0))
    with held(write_study(tmp_path / "study"), monkeypatch, play=1.5, email="admin@example.org") as world:
        yield world


@pytest.fixture
def running_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningInstallation]:
    """A running installation with one live study in which two participants play together."""
    monkeypatch.setattr(study_copy, "FRESH", timedelta(0))
    both = {"players": {"left": "human", "right": "human"}, "countdown": 0, "actionSpace": ["noop", "up", "down"]}
    study = write_study(
        tmp_path / "study",
        agent=two_players(length=100_000),
        project={"players": 2},
        trial={**both, "ui": {"up": True, "down": True, "start": True}},
    )
    with held(study, monkeypatch, play=1.5, email="admin@example.org", together=True) as world:
        yield world


def play(running: RunningInstallation, capsys: Any, *arguments: str) -> CommandResult:
    return running.run(capsys, "doctor", "--all", "--only-aws", "--rehearse", "--play", "1", "--yes", *arguments)


def documents(running: RunningInstallation) -> set[str]:
    """Return the documents in the bucket, by key."""
    return set(running.keys())


def versions(running: RunningInstallation) -> set[str]:
    """Return the keys of every version and delete marker."""
    found = running.client("s3").list_object_versions(Bucket=running.env["BUCKET"])
    return {line["Key"] for line in [*found.get("Versions", ()), *found.get("DeleteMarkers", ())]}


def assert_nothing_left(running: RunningInstallation) -> None:
    assert [task.name for task in running.platform.tasks.list()] == []
    assert (running.records(), running.timers()) == ({}, {})
    assert [key for key in versions(running) if "rehearsal" in key or key.startswith("_servers/")] == []
    assert [one.id for one in registered_projects(running.platform.documents)] == [STUDY]


# The whole


def test_a_rehearsal_proves_every_line_and_leaves_nothing(
    running: RunningInstallation, capsys: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(study_copy, "FRESH", FRESH)
    running.visited = f"projectId={STUDY}&userId=somebody"  # then a function has just read the list of projects
    until(lambda: f"{STUDY}/users/somebody/participant.json" in documents(running))
    before, file = documents(running), tmp_path / "transcript.json"
    ran = play(running, capsys, "--json", "--transcript", str(file))
    assert ran.code == Exit.DONE, ran.out
    told = json.loads(file.read_text())
    assert told == ran.json["transcript"]
    assert {line["mark"] for line in told["lines"]} == {"good"}
    assert list(told["proven"]) == list(LINES), "each line is a promise that one run keeps"
    assert [one["check"] for one in ran.json["checks"][-len(LINES) :]] == [line["key"] for line in told["lines"]]
    texts = {line["key"]: line["text"] for line in told["lines"]}
    assert texts["pages"] == "2 of 2 bots finished, with 6 forms answered."
    assert texts["killed"].startswith("The server counted as lost (spot); another was ready")
    assert texts["servers"].startswith("2 ran, 2 of them on Spot")
    assert texts["data"].startswith("8 answers and 3 recordings")
    assert KILLED in running.stopped
    assert running.alarmed == ["ALARM", "OK"]
    # The transcript names no participant and no account, and holds no secret.
    secrets = {*running.secrets, ACCOUNT, running.root_domain, running.env["BUCKET"], running.ids["zone"], "arn:aws"}
    assert [secret for secret in secrets if secret in file.read_text() or secret in ran.err] == []
    assert len(secrets) > 10
    # Nothing of the rehearsal is left.
    assert documents(running) == before
    assert_nothing_left(running)


def test_a_rehearsal_of_a_study_for_two_counts_their_session_once(
    running_pair: RunningInstallation, capsys: Any
) -> None:
    ran = play(running_pair, capsys, "--json")
    told = ran.json["transcript"]
    assert {line["key"]: line["text"] for line in told["lines"] if line["mark"] != "good"} == {}, ran.out
    assert list(told["proven"]) == list(LINES)
    texts = {line["key"]: line["text"] for line in told["lines"]}
    assert texts["pages"].startswith("2 of 2 bots finished")
    assert texts["servers"].startswith("1 ran, 1 of them on Spot")
    assert texts["killed"].startswith("The server counted as lost (spot); another was ready")
    assert texts["end"].startswith("1 server ended")
    assert " for 3 servers with " in texts["cost"], "the session's two attempts, and the one that its timer ends"
    assert_nothing_left(running_pair)


def test_a_failed_line_has_a_remedy_and_the_rest_goes_on(
    running: RunningInstallation, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    running.broken["hippodrome-sweep"] = '{"errorType": "KeyError", "errorMessage": "secret"}'
    running.without_alarms = running.without_timers = True
    monkeypatch.setattr(rehearsal_with_bots, "ACTED", 0.5)
    monkeypatch.setattr(rehearsal_with_bots, "FIRED", 0.5)
    ran = play(running, capsys, "--json")
    assert ran.code == Exit.FAILED
    told = {line["key"]: line for line in ran.json["transcript"]["lines"]}
    assert {key for key, line in told.items() if line["mark"] != "good"} == {"timer", "sweep", "alarm"}
    assert "Its timer has not fired" in told["timer"]["text"]
    assert "There is no closed server" in told["sweep"]["text"]
    assert "its topic was not told" in told["alarm"]["text"]
    assert all(told[key]["advice"] for key in ("timer", "sweep", "alarm"))
    assert set(told) == set(LINES)
    assert running.alarmed == ["ALARM", "OK"], "it was set back all the same"
    assert_nothing_left(running)


def test_ctrl_c_during_the_rehearsal_removes_everything(
    running: RunningInstallation, capsys: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    watch = Play._watch

    def pressed(self: Play, reports: Any) -> None:
        watch(self, reports)
        if any(report.stage == "plays" for report in reports):
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Play, "_watch", pressed)
    ran = play(running, capsys, "--transcript", str(tmp_path / "transcript.json"))
    assert ran.code == Exit.INTERRUPTED
    assert running.secrets, "servers had been started"
    assert_nothing_left(running)
    told = json.loads((tmp_path / "transcript.json").read_text())
    assert [line["key"] for line in told["lines"]][-2:] == ["cost", "erased"]
    assert "data" not in told["proven"]


def test_a_closed_terminal_while_a_server_is_being_asked_for_leaves_nothing(
    running: RunningInstallation, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Play, "_site", lambda _: os.kill(os.getpid(), signal.SIGHUP))
    ran = play(running, capsys)
    assert ran.code == Exit.INTERRUPTED
    assert "✓ erased: The copy and the bots' data are gone" in ran.err
    assert_nothing_left(running)


def doctors_context() -> CheckContext:
    account = account_here()
    return CheckContext(account, find_installation(account), 20, datetime.now(UTC))


def test_a_rehearsal_that_was_killed_is_removed_by_the_next(running: RunningInstallation) -> None:
    context = doctors_context()
    copy = StudyCopy(context)
    copy.make(registered_projects(context.platform.documents)[0])
    running.put(f"{copy.id}/users/{copy.user('1')}/answers/1.json", b"{}")
    running.record(copy.user("2"), ServerState.CLOSED, copy.project)  # only a server's record is left of it
    running.record(copy.user("3"), ServerState.READY, copy.project)
    now = datetime.now(UTC)
    assert left_behind(context, now) == [], "it may be under way"
    assert left_behind(context, now + timedelta(hours=3)) == [copy.id]
    unregister(context.platform.documents, copy.id)  # the removal was killed, too
    assert left_behind(context, now + timedelta(hours=3)) == [copy.id]
    deleted, servers = StudyCopy(context, copy.id).remove()
    assert (deleted > 5, len(servers)) == (True, 2)
    assert left_behind(context, now + timedelta(hours=3)) == []
    assert_nothing_left(running)


def test_sessions_the_lobby_and_the_cells_of_a_copy_are_removed_too(running: RunningInstallation) -> None:
    context = doctors_context()
    copy = StudyCopy(context)
    copy.make(registered_projects(context.platform.documents)[0])
    walked, sid, ahead = copy.user("1"), f"s.{1:020x}", f"s.{2:020x}"
    running.put(f"{copy.id}/users/{walked}/participant.json", b"{}")
    running.put(session_key(copy.id, sid), SessionDocument(sid, 2, (Member(walked, None, 0),)).to_json())
    running.record(sid, ServerState.CLOSED, copy.project)
    running.record(ahead, ServerState.READY, copy.project)
    running.put(f"_lobby/{copy.id}/slabel.way", b"{}")
    running.put(decisions.key(copy.id), to_json(Decisions(1, open=(OpenSession(ahead, datetime.now(UTC)),))))
    running.put(cells_key(copy.id), b"{}")
    copy.remove()
    assert_nothing_left(running)
    assert running.keys("_lob") == running.keys("_cells") == []


@pytest.mark.parametrize("name", ["rehearsal-20261122", "rehearsal-deadbeef", "rehearsal-1"])
def test_a_study_whose_id_resembles_that_of_a_copy_is_not_removed(installed: Installed, name: str) -> None:
    installed.put(f"{name}/steps/consent.html", b"")
    assert left_behind(doctors_context(), datetime.now(UTC) + timedelta(days=1)) == []


def test_unreadable_entries_of_the_list_of_projects_stay_unchanged() -> None:
    copy, other = (msgspec.structs.replace(study(), id=name) for name in ("rehearsal-00000000", "maze"))
    strange = UnreadableEntry(b'{"id":"old-study","steps":7,"secret":"kept"}', "old-study", "")
    with MotoWorld() as world:
        documents = world.platform.documents
        documents.create(MASTER_LIST, write_list(MasterList([copy, other], (strange,))))
        unregister(documents, copy.id)
        found = documents.get(MASTER_LIST)
        unregister(documents, copy.id)
        again = documents.get(MASTER_LIST)
    assert found
    assert [project.id for project in read_list(found.body).projects] == [other.id]
    assert json.loads(strange.raw) in json.loads(found.body)["projects"]
    assert again
    assert again.etag == found.etag, "nothing to do, nothing written"


# Asking


def test_a_rehearsal_needs_a_yes(running: RunningInstallation, capsys: Any) -> None:
    before = documents(running)
    ran = running.run(capsys, "doctor", "--all", "--only-aws", "--rehearse", "--play", "3")
    assert ran.code == Exit.DECLINED
    assert re.search(r"3 bots and three servers more, .* It costs about \$0\.\d\d, \$0\.\d\d at most", ran.err), ran.err
    assert documents(running) == before


def test_play_needs_rehearse(running: RunningInstallation, capsys: Any) -> None:
    ran = running.run(capsys, "doctor", "--all", "--play", "1")
    assert (ran.code, "--rehearse --play" in ran.err) == (Exit.FAILED, True)


def test_a_transcript_that_cannot_be_written_stops_the_rehearsal_beforehand(
    running: RunningInstallation, capsys: Any
) -> None:
    ran = play(running, capsys, "--transcript", "/nowhere/transcript.json")
    assert (ran.code, "There is no folder /nowhere" in ran.err) == (Exit.FAILED, True)
    assert running.secrets == set()


# The copy


def test_the_copy_differs_from_the_study_only_where_it_must() -> None:
    before = study(
        max_runtime=120,
        max_participants=5,
        max_servers=2,
        max_server_hours=9,
        warm_servers=3,
        subdomain="userId",
        plain_clients=True,
        front_end=["https://play.example.org"],
        page_folder="",
        trial={"game": "x/Y-v0", "ui": {"left": True}},
    )
    after = changed(before, "rehearsal-00000000")
    same = {name for name in before.__struct_fields__ if getattr(before, name) == getattr(after, name)}
    assert set(before.__struct_fields__) - same == {
        "id",
        "signed_links",
        "max_runtime",
        "max_participants",
        "max_servers",
        "max_server_hours",
        "warm_servers",
        "subdomain",
        "plain_clients",
        "front_end",
        "page_folder",
        "trial",
    }
    assert after.plain_clients is False
    assert after.trial == {"game": "x/Y-v0", "ui": {"left": True, "stop": True}}
    assert after.max_runtime == 30


def test_the_copy_has_the_pages_of_the_study() -> None:
    platform = FakePlatform()
    for key in (
        "one.html",
        "steps/one.html",
        "steps/photo.png",
        "two-0.html",
        "two-1.html",
        "users/u/participant.json",
    ):
        platform.documents.put(f"s/{key}", b"")
    steps = [Step("1", "one"), Step("2", "game"), Step("3", "two", 2)]
    at_top = study(id="s", steps=steps, page_folder="")
    assert page_files(platform.documents, at_top) == {
        "s/one.html": "one.html",
        "s/two-0.html": "two-0.html",
        "s/two-1.html": "two-1.html",
        "s/steps/photo.png": "photo.png",
    }
    below = page_files(platform.documents, study(id="s", steps=steps))
    assert below == {"s/steps/one.html": "one.html", "s/steps/photo.png": "photo.png"}


# The transcript


@pytest.mark.parametrize(
    "text",
    [
        "arn:aws:ecs:us-east-1:123456789012:task/hippodrome/0f1e2d3c4b5a69788796a5b4c3d2e1f0",
        "s" + "a2" * 10 + "-1 is gone",
        "s" + "b" * 20,
        "bot-00aa11bb-victim: no answer",
        "no project rehearsal-00aa11bb",
        "account 123456789012",
        "at 203.0.113.7:443",
        "https://study/next?projectId=x&signature=00112233445566778899aabbccddeeff",
        "ticket 00112233445566778899aabbccddeeff",
    ],
)
def test_a_transcript_holds_no_names_and_no_secrets(text: str) -> None:
    cleaned = Transcript().clean(text)
    assert "…" in cleaned
    for kept in re.findall(r"[0-9a-f]{8,}|\d+\.\d+\.\d+|s[a-z2-7]{20}", text):
        assert kept not in cleaned


def test_a_transcript_cleans_and_shortens_messages_of_a_hostile_server() -> None:
    cleaned = Transcript().clean("the game says: \x1b]52;c;aGk=\x07 \x9b2J \u202e nothing\r\n✓ game: " + "x" * 100_000)
    assert cleaned.isprintable()
    assert len(cleaned) < 2_000
    assert "✓ game" in cleaned


def test_a_transcript_hides_the_longest_secret_first() -> None:
    transcript = Transcript()
    transcript.hide("token", "token-of-ada", None, "")
    assert transcript.clean("a token-of-ada, a token") == "a …, a …"


def test_a_line_that_was_bad_once_is_not_proven() -> None:
    transcript = Transcript()
    transcript.say("pages", Mark.GOOD, "fine")
    transcript.say("data", Mark.GOOD, "fine")
    transcript.say("pages", Mark.BAD, "not so fine", "look")
    assert transcript.proven == ["data"]
    with pytest.raises(KeyError):
        transcript.say("something else", Mark.GOOD, "fine")


# What the documentation promises


def claims() -> dict[str, str]:
    """Return each claim of docs/unproven.md, with the line that says how to prove it."""
    page = (ROOT / "docs/unproven.md").read_text()
    found = re.findall(r"^\* \*\*(.+)\.\*\* .+\n  \* \*Proof\*: (.+)\n", page, re.MULTILINE)
    assert len(found) == len(dict(found)) == page.count("* *Proof*:"), "a claim has another form, or stands twice"
    return dict(found)


def arrows() -> dict[str, list[str]]:
    """Return the lines of the transcript that each claim of docs/unproven.md names."""
    return {claim: re.findall(r"`(.*?)`", proof.partition("→")[2]) for claim, proof in claims().items()}


def test_claims_of_unproven_name_only_lines_of_a_transcript() -> None:
    assert {what: keys for what, keys in arrows().items() if set(keys) - set(LINES)} == {}


def test_each_arrow_of_unproven_leads_to_keys_alone() -> None:
    proofs = [proof for proof in claims().values() if "→" in proof]
    assert proofs
    assert [each for each in proofs if not re.search(r"→ `\w+`(, `\w+`)*$", each) or each.count("→") > 1] == []


@pytest.mark.parametrize("key", LINES)
def test_each_line_proves_a_claim_of_unproven(key: str) -> None:
    assert key == "links" or key in {key for keys in arrows().values() for key in keys}


def test_running_md_explains_each_line_as_the_program_does() -> None:
    section = (ROOT / "docs/running.md").read_text().partition("### The rehearsal with bots")[2].partition("\n## ")[0]
    told = re.findall(r"^\| `(\w+)` \| (.*) \|$", section, re.MULTILINE)
    assert dict(told) == dict(LINES)
