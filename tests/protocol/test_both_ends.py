"""The same inputs at both ends: what the control plane writes is what the trial reads, and the other way round."""

from __future__ import annotations

import ast
import asyncio
import io
import json
import re
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.config import ConfigErrors, parse_registration
from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Server
from hippodrome.control.participants.answers import Answers
from hippodrome.control.ports import TaskRequest
from hippodrome.control.servers.signing import DocumentRequest, Method, ServerAccess
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from hippodrome.protocol import environment
from hippodrome.protocol.answer import Answer, to_json
from hippodrome.protocol.handover import Handover, parse
from hippodrome.protocol.keys import answer_key, handover_key, recordings_folder
from hippodrome.trial.recordings.recorder import Recorder, Spool
from hippodrome.trial.recordings.store import FolderStore
from hippodrome.trial.server import assignment
from hippodrome.trial.settings import SettingsError, TrialSettings, trial_section
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import installed, study
from testing.visitors import visit_of

ROOT = Path(__file__).parents[2]
VARIABLES = {value for name, value in vars(environment).items() if name.isupper() and isinstance(value, str)}


def task_request(platform: FakePlatform, user: str = "alice") -> TaskRequest:
    """Start a server; return the request to ECS for the participant's server."""
    Servers(platform).start(StartServer("maze", user))
    (found,) = platform.tasks.running.values()
    return found


def variables_of(found: TaskRequest) -> dict[str, str]:
    """Return all variables that the container of this server gets."""
    tasks = EcsTasks(lambda: None, lambda: None, {"SIGN_URL": "https://study.example.org/sign"}.__getitem__)
    (container,) = tasks._overrides(found)["containerOverrides"]
    return {each["name"]: each["value"] for each in container["environment"]}


# ---- environment variables


def test_a_trial_reads_what_the_control_plane_has_written() -> None:
    platform = installed(study())
    found = task_request(platform)
    record = from_json(platform.documents.kept[server.key(ids.server_label("maze", "alice"))][0], Server)
    settings = TrialSettings.from_env(variables_of(found))
    assert (settings.project_id, settings.user_id, settings.server) == ("maze", "alice", record.name)
    assert settings.token == SecretCache(platform.documents).token(record)
    assert settings.credential == SecretCache(platform.documents).get_or_create().credential(record.name, record.nonce)
    assert settings.game_steps == ("3",)
    assert settings.group == ids.group("maze", "alice", 2)
    assert settings.deadline == int(record.deadline.timestamp())
    assert settings.store == "https://study.example.org/sign"
    assert (settings.tls, settings.port, settings.warm_server) == (True, record.port, False)
    assert settings.trial == trial_section(study().trial)


class RecordingEnvironment(dict[str, str]):
    """Environment variables that record the names of the variables that were read."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.names: set[str] = set()

    def get(self, key: str, default: Any = None) -> Any:
        self.names.add(key)
        return super().get(key, default)

    def __getitem__(self, key: str) -> str:
        self.names.add(key)
        return super().__getitem__(key)


def test_the_protocol_names_every_variable_that_either_end_uses() -> None:
    told = RecordingEnvironment(variables_of(task_request(installed(study()))))
    TrialSettings.from_env(told)
    assert set(told) <= VARIABLES
    assert told.names == VARIABLES
    image = (ROOT / "infra/Dockerfile").read_text(encoding="utf-8")
    assert re.search(rf"^\s+{environment.AGENT_DIR}=", image, re.MULTILINE)


def string_constants(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


@pytest.mark.parametrize("package", ["control", "functions", "local", "deployment", "trial"])
def test_only_the_protocol_writes_the_names_of_variables(package: str) -> None:
    modules = sorted((ROOT / "hippodrome" / package).rglob("*.py"))
    assert modules
    found = {module.relative_to(ROOT).as_posix(): VARIABLES & set(string_constants(module)) for module in modules}
    assert {module: names for module, names in found.items() if names} == {}


# ---- the trial section

SECTIONS: dict[str, dict[str, Any]] = {
    "nothing": {"game": "x"},
    "text for numbers": {"game": "x", "maxEpisodes": "3", "startingFrameRate": " 12 "},
    "words for flags": {"game": "x", "s3upload": "no", "lossless": "yes", "ui": {"start": "on"}},
    "a scene": {"game": "x", "scene": {"width": 300, "background": "#FFFFFF"}},
    "a scene of defaults": {"game": "x", "scene": {}},
    "a scene that leaves the folder": {"game": "x", "scene": {"assets": "../../etc"}},
    "a misspelt key": {"game": "x", "allowFramRateChange": True},
    "names of actions": {"game": "x", "actionSpace": ["NOOP", "Up", 3]},
    "too fast": {"game": "x", "startingFrameRate": 1000},
    "the least above the most": {"game": "x", "minFrameRate": 30, "maxFrameRate": 20},
    "two actions of one name": {"game": "x", "actionSpace": ["up", "UP"]},
    "a list for a section": {"game": "x", "ui": ["start"]},
}


@pytest.mark.parametrize("name", SECTIONS)
def test_a_trial_takes_the_sections_that_can_be_registered_and_no_others(name: str) -> None:
    steps = [{"key": "1", "page": "game"}, {"key": "2", "page": "bye"}]
    try:
        registered = parse_registration({"id": "maze", "steps": steps, "trial": SECTIONS[name]})
    except ConfigErrors:
        with pytest.raises(SettingsError, match="trial"):
            trial_section(SECTIONS[name])
    else:
        assert trial_section(registered["trial"]) == trial_section(SECTIONS[name])


# ---- the handover


def test_a_warm_server_reads_the_handover_that_was_written_for_it() -> None:
    for group in (None, 0, 3):
        written = Handover("P1", group, "saaaaaaaaaaaaaaaaaaaa-2")
        assert parse(written.to_json()) == written
    env = {"PROJECT_ID": "maze", "SERVER": "s-1", "TOKEN": "t", "GAME_STEPS": "3", "STORE": "x", "TLS": "off"}
    waiting = TrialSettings.from_env({**env, "WARM_SERVER": "on", "TRIAL": "{}"})
    own = assignment.with_handover(waiting, parse(Handover("P1", 3, "a-2").to_json()))
    assert own == TrialSettings.from_env({**env, "USER_ID": "P1", "GROUP": "3", "SERVER": "a-2", "TRIAL": "{}"})


def test_a_handover_of_an_earlier_version_is_read() -> None:
    assert parse(b'{"userId": "P1", "group": null, "server": "a-2"}') == Handover("P1", None, "a-2")
    assert parse(b'{"schema": 1, "userId": "P1", "group": 0, "server": "a-2"}') == Handover("P1", 0, "a-2")


# ---- the answer


def test_the_control_plane_reads_a_trials_answer_and_the_participant_goes_on(tmp_path: Path) -> None:
    project, platform = study(), installed(study())
    played = {"episodes": 2, "score": 1.5, "outcome": "finished"}

    async def write() -> None:
        env = {"PROJECT_ID": "maze", "USER_ID": "alice", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3"}
        settings = TrialSettings.from_env({**env, "STORE": str(tmp_path), "TLS": "off", "TRIAL": "{}", "GROUP": "1"})
        store = FolderStore(tmp_path)
        await Recorder(settings, "3", "the-trial", store, Spool(settings, store)).save(played)

    asyncio.run(write())
    (path,) = tmp_path.rglob("answers/*.json")
    key = path.relative_to(tmp_path).as_posix()
    assert key == answer_key("maze", "alice", "3") == "maze/users/alice/answers/3.json"
    platform.documents.put(key, path.read_bytes())
    answers, visit = Answers(platform.documents), visit_of(project)
    assert answers.read(visit, "3") == played
    assert "3" in Repository(platform.documents).progress("maze", "alice").answered
    found = json.loads(path.read_bytes())
    assert (found["step"], found["page"], found["group"], found["schema"]) == ("3", "game", 1, 1)
    answers.store(visit, project.steps[0], {"age": "30"})
    written = json.loads(platform.documents.kept[answer_key("maze", "alice", project.steps[0].key)][0])
    assert written.keys() == found.keys()
    stored = datetime.fromisoformat(written["answered"]), datetime.fromisoformat(found["answered"])
    assert all(when.tzinfo == UTC for when in stored)


DOCUMENTS = {
    "of a trial": b'{"schema": 1, "step": "3", "page": "game", "group": null, "answers": {"score": 3}}',
    "of a page": to_json(Answer("3", "survey.html", 0, datetime(2026, 11, 21, tzinfo=UTC), {"age": "30"})),
    "nothing": b"",
    "no answers": b"{}",
    "a list": b"[1]",
    "answers that are none": b'{"answers": [1]}',
    "no text": b"\xff\xfe",
    "too deep": b"[" * 100_000,
    "NaN": b'{"answers": {"score": NaN}}',
    "an infinity": b'{"answers": {"score": -Infinity}}',
    "a number too large": b'{"answers": {"score": 1e999}}',
    "half of a surrogate pair": b'{"answers": {"name": "\\ud800"}}',
    "UTF-16": '{"answers": {"score": 3}}'.encode("utf-16"),
    "a byte order mark": b'\xef\xbb\xbf{"answers": {"score": 3}}',
}


ANSWERS = {"of a trial": {"score": 3}, "of a page": {"age": "30"}}


@pytest.mark.parametrize("name", DOCUMENTS)
def test_both_ends_read_the_same_answers_in_a_document(name: str, tmp_path: Path, log: io.StringIO) -> None:
    platform, store = installed(study()), FolderStore(tmp_path)
    platform.documents.put(answer_key("maze", "alice", "3"), DOCUMENTS[name])
    store.create(answer_key("maze", "alice", "3"), DOCUMENTS[name])
    env = {"PROJECT_ID": "maze", "USER_ID": "alice", "SERVER": "a-1", "TOKEN": "t", "GAME_STEPS": "3"}
    settings = TrialSettings.from_env({**env, "STORE": str(tmp_path), "TLS": "off", "TRIAL": "{}", "GROUP": "1"})
    recorder = Recorder(settings, "3", "the-trial", store, Spool(settings, store))
    assert Answers(platform.documents).read(visit_of(study()), "3") == ANSWERS.get(name, {})
    assert asyncio.run(recorder.earlier_answers()) == ANSWERS.get(name, {})
    assert ("holds no answers" in log.getvalue()) is (name not in ANSWERS)


# ---- keys


def test_a_server_may_create_and_read_the_documents_of_its_trial() -> None:
    label = ids.server_label("maze", "alice")
    server_access = ServerAccess(f"{label}-2", "maze", "alice", label, 2, game_steps=("3",))
    recordings = recordings_folder("maze", "alice")
    assert server_access.allows(DocumentRequest(Method.PUT, answer_key("maze", "alice", "3"), 100))
    assert server_access.allows(DocumentRequest(Method.PUT, f"{recordings}{label}-2/3-episode-0001.jsonl.gz", 100))
    assert server_access.allows(DocumentRequest(Method.GET, f"{recordings}{label}-1/3-trial.jsonl.gz"))
    assert server_access.allows(DocumentRequest(Method.GET, handover_key("maze", f"{label}-2")))
    assert not server_access.allows(DocumentRequest(Method.GET, handover_key("maze", f"{label}-3")))
    assert Progress.from_listing("maze/users/alice/", []) == Progress()
