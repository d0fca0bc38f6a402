"""Servers as processes: their events, and that none is left over at whatever moment this process is killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import connect

from hippodrome.console import run_state
from hippodrome.control.model import messages
from hippodrome.control.ports import Address, Refused, TaskRequest
from hippodrome.local.backend import processes, task_process
from hippodrome.local.backend import tasks as tasks_module
from hippodrome.local.backend.processes import end_everything, marked
from hippodrome.local.backend.tasks import ProcessTasks
from hippodrome.protocol.handover import Handover
from hippodrome.trial.gym import linux
from hippodrome.trial.recordings import recording
from testing.waiting import until
from tests.local.conftest import ROOT

FAKE = (sys.executable, str(Path(__file__).parents[1] / "fake_trial.py"))
NAME = "saaaaaaaaaaaaaaaaaaaa-1"


def request(name: str = NAME, **environment: str) -> TaskRequest:
    own = {"TOKEN": "secret", "PROJECT_ID": "study", "USER_ID": "P1", "TRIAL": "{}", **environment}
    return TaskRequest(name, "hippodrome", "hippodrome", cpu=1, memory=2, environment=own)


class Here:
    """A state folder, and the processes' tasks that follow each other on it."""

    def __init__(self, tmp_path: Path) -> None:
        self.state = tmp_path / "state"
        self.data = tmp_path / "data"
        self.project = tmp_path / "project"
        self.project.mkdir()
        self.events: list[dict[str, Any]] = []
        self.made: list[ProcessTasks] = []

    def tasks(self, command: tuple[str, ...] = FAKE, stop_timeout: float = 30) -> ProcessTasks:
        made = ProcessTasks(
            self.state,
            self.data,
            self.events.append,
            command=command,
            stop_timeout=stop_timeout,
            say=lambda text: None,
        )
        made.add_project("study", self.project)
        self.made.append(made)
        return made

    def wait(self, status: str, name: str = NAME, seconds: float = 60) -> dict[str, Any]:
        """Wait for the event with this status. Returns its detail."""
        until = time.monotonic() + seconds
        while True:
            for event in list(self.events):
                if event["detail"]["startedBy"] == name and event["detail"]["lastStatus"] == status:
                    return event["detail"]  # type: ignore[no-any-return]
            assert time.monotonic() < until, [event["detail"]["lastStatus"] for event in self.events]
            time.sleep(0.02)

    def processes(self) -> list[str]:
        return sorted(marked(self.state))

    def log(self, name: str = NAME) -> str:
        return (self.state / "logs" / f"{name}.log").read_text()


@pytest.fixture
def here(tmp_path: Path) -> Iterator[Here]:
    made = Here(tmp_path)
    yield made
    for tasks in made.made:
        tasks.close(0.2)
    end_everything(made.state)


def test_a_server_that_runs_and_is_stopped_has_the_events_of_ecs(here: Here) -> None:
    tasks = here.tasks()
    arn = tasks.run(request())
    running = here.wait("RUNNING")
    assert running["taskArn"] == arn
    assert running["startedBy"] == NAME
    [eni] = running["attachments"]
    assert eni["type"] == "eni"
    interface = {item["name"]: item["value"] for item in eni["details"]}["networkInterfaceId"]
    address = tasks.addresses([interface])[interface]
    assert address == Address("127.0.0.1", json.loads(here.log().splitlines()[0])["port"])
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    stopped = here.wait("STOPPED")
    assert stopped["stopCode"] == "UserInitiated"
    assert stopped["stoppedReason"] == "hippodrome: enough"
    assert stopped["containers"][0]["exitCode"] == 0
    assert stopped["desiredStatus"] == "STOPPED"
    assert [event["detail"]["lastStatus"] for event in here.events] == ["RUNNING", "STOPPED"]
    assert here.processes() == []
    assert tasks.addresses([interface]) == {}
    read = [messages.parse_task_changed(json.loads(json.dumps(event))) for event in here.events]
    assert [(found.status, found.interface, found.cluster) for found in read if found] == [
        ("RUNNING", interface, "hippodrome"),
        ("STOPPED", interface, "hippodrome"),
    ]


def test_a_server_gets_its_environment(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "not for servers")
    here.tasks().run(request())
    here.wait("RUNNING")
    assert json.loads(here.log().splitlines()[1]) == {
        "STORE": str(here.data),
        "SPOOL": str(here.state / "spool"),
        "TLS": "off",
        "AGENT_DIR": str(here.project),
        "TOKEN": "secret",
    }
    [server] = marked(here.state)[NAME]
    assert "AWS_SECRET_ACCESS_KEY" not in server.environ()
    assert server.cwd() == str(here.project)
    assert "secret" not in (here.state / "tasks" / f"{NAME}.json").read_text()


def test_only_servers_of_projects_with_a_language_model_get_its_key(
    here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LLM_KEY", "sk-1")
    tasks, names = here.tasks(), [f"s{letter * 20}-1" for letter in "ab"]
    tasks.add_project("talks", here.project, has_model=True)
    tasks.add_project("plays", here.project)
    for name, project in zip(names, ("talks", "plays"), strict=True):
        tasks.run(request(name, PROJECT_ID=project))
        here.wait("RUNNING", name)
    keys = [{process.environ().get("LLM_KEY") for process in marked(here.state)[name]} for name in names]
    assert keys == [{"sk-1"}, {None}]


@pytest.mark.parametrize("status", [0, 3])
def test_the_end_of_a_server_is_reported_with_its_exit_code(here: Here, status: int) -> None:
    tasks = here.tasks()
    arn = tasks.run(request(FAKE_SECONDS="0.3", FAKE_STATUS=str(status)))
    stopped = here.wait("STOPPED")
    assert stopped["stopCode"] == "EssentialContainerExited"
    assert stopped["containers"][0]["exitCode"] == status
    assert tasks.find(NAME, "hippodrome") is None
    assert tasks.run(request()) == arn, "the same name is the same task, also when it is over"
    assert here.processes() == []


def test_a_server_that_never_listens_is_ended(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(task_process, "START_TIMEOUT", 0.3)
    here.tasks().run(request(FAKE_SILENT="yes"))
    here.wait("STOPPED")
    until(lambda: not here.processes())  # SIGKILL was sent to its group, and takes a moment to have its effect


def test_a_task_that_cannot_run_is_refused(here: Here) -> None:
    here.project.rmdir()
    tasks = here.tasks()
    with pytest.raises(Refused):
        tasks.run(request())
    assert list(tasks.list()) == []
    assert list((here.state / "tasks").iterdir()) == []


def test_a_server_of_a_study_that_is_not_served_here_is_refused(here: Here) -> None:
    with pytest.raises(Refused, match="not served here"):
        here.tasks().run(request(PROJECT_ID="another"))
    assert here.processes() == []


def test_stop_does_not_wait_for_the_servers_end(here: Here) -> None:
    tasks = here.tasks(stop_timeout=600)
    arn = tasks.run(request(FAKE_STUBBORN="yes"))
    here.wait("RUNNING")
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    assert here.processes() == [NAME]


def test_a_server_that_ignores_sigterm_is_killed(here: Here) -> None:
    tasks = here.tasks(stop_timeout=0.5)
    arn = tasks.run(request(FAKE_STUBBORN="yes"))
    here.wait("RUNNING")
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    assert here.wait("STOPPED")["containers"][0]["exitCode"] == 137
    until(lambda: not here.processes())  # SIGKILL was sent to its group, and takes a moment to have its effect


def test_a_server_can_be_stopped_before_its_process_starts(here: Here) -> None:
    tasks = here.tasks()
    tasks.stop(tasks.run(request()), "hippodrome", "hippodrome: enough")
    assert here.wait("STOPPED")["stopCode"] == "UserInitiated"


def test_child_processes_of_a_server_end_with_it(here: Here, tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(
        "import subprocess, sys, json\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])\n"
        "print(child.pid, flush=True)\n"
    )
    here.tasks(command=(sys.executable, str(script))).run(request())
    here.wait("STOPPED")
    child = int(here.log().split()[0])
    until(lambda: not linux.runs(child))


def left_by_a_killed_run(here: Here, **environment: str) -> None:
    """Begin a server in another process, which is killed."""
    arguments = [here.state, here.data, here.project, json.dumps(environment)]
    assert subprocess.run([sys.executable, "-c", BEGIN, *map(str, arguments)], cwd=ROOT, check=False).returncode < 0
    until(here.processes)


BEGIN = """
import json, os, signal, sys
from pathlib import Path
from hippodrome.local.backend.tasks import ProcessTasks
from tests.local.backend.test_tasks import FAKE, request
state, data, project = map(Path, sys.argv[1:4])
tasks = ProcessTasks(state, data, lambda event: None, command=FAKE)
tasks.add_project("study", project)
tasks.run(request(**json.loads(sys.argv[4])))
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.mark.parametrize("environment", [{}, {"FAKE_STUBBORN": "yes"}], ids=["", "ignores SIGTERM"])
def test_servers_that_a_killed_run_has_left_are_ended(
    here: Here, monkeypatch: pytest.MonkeyPatch, environment: dict[str, str]
) -> None:
    monkeypatch.setattr(tasks_module, "LEFT_SECONDS", 1)
    left_by_a_killed_run(here, **environment)
    tasks = here.tasks()
    tasks.clear()
    assert here.processes() == []
    tasks.run(request())
    here.wait("RUNNING")
    assert len(marked(here.state)) == 1


def marked_process(here: Here, code: str, **options: Any) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-X", run_state.mark_of(here.state, NAME), "-c", code]
    return subprocess.Popen(command, **({"start_new_session": True} | options))


def test_the_id_of_a_group_that_has_ended_may_be_another_programs(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    server, killed = marked_process(here, "import time; time.sleep(60)"), list[int]()
    until(here.processes)
    monkeypatch.setattr(processes, "kill_group", killed.append)
    end_everything(here.state, 30)  # it ends at SIGTERM
    server.wait()
    assert killed == []


WORKER = """
import os, signal, time
if os.fork() == 0:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    time.sleep(600)
"""


def test_a_worker_that_outlives_its_server_is_ended(here: Here) -> None:
    marked_process(here, WORKER).wait()
    [worker] = marked(here.state)[NAME]
    end_everything(here.state, 0.2)
    until(lambda: not linux.runs(worker.pid), 5)


def test_a_job_of_a_shell_that_only_names_a_server_goes_on(here: Here) -> None:
    job = marked_process(here, "import time; time.sleep(60)", start_new_session=False, process_group=0)
    end_everything(here.state, 0.2)
    assert job.poll() is None
    job.kill()
    job.wait()


@pytest.mark.parametrize("kept", [True, False])
def test_recordings_that_a_killed_run_has_left_are_kept_if_the_study_keeps_any(here: Here, kept: bool) -> None:
    tasks = here.tasks()
    tasks.add_project("study", here.project, keeps_recordings=kept)
    half_a_game(here)
    tasks.clear()
    assert (here.data / PLAYED / "3-trial.jsonl.gz").exists() is kept


def test_a_running_server_names_its_owner_and_its_process_for_erase(here: Here) -> None:
    tasks = here.tasks()
    arn = tasks.run(request())
    here.wait("RUNNING")
    note = here.state / "tasks" / f"{NAME}.json"
    assert json.loads(note.read_text()) == {"folder": "study/users/P1", "pid": marked(here.state)[NAME][0].pid}
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    until(lambda: not note.exists())


def test_a_recording_of_a_killed_server_is_kept(here: Here) -> None:
    folder = f"study/users/P1/trials/{NAME}"
    tasks = here.tasks(stop_timeout=0.2)
    arn = tasks.run(request(FAKE_STUBBORN="yes"))
    here.wait("RUNNING")
    (here.state / "spool" / folder).mkdir(parents=True)
    (here.state / "spool" / folder / "3-trial.jsonl.gz.part").write_bytes(b"half a game")
    (here.state / "spool" / folder / "5-trial.jsonl.gz.part").touch()  # nothing was written: the disk was full
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    here.wait("STOPPED")
    assert (here.data / folder / "3-trial.jsonl.gz").read_bytes() == b"half a game"
    assert [path.name for path in (here.data / folder).iterdir()] == ["3-trial.jsonl.gz"]
    assert not list((here.state / "spool").rglob("*.part"))


def test_a_recording_of_a_killed_server_of_a_session_is_kept_with_the_session(here: Here) -> None:
    folder = f"study/sessions/{SESSION}/trials/{NAME}"
    here.tasks().run(request(SESSION=SESSION, USER_ID=""))
    here.wait("RUNNING")
    (here.state / "spool" / folder).mkdir(parents=True)
    (here.state / "spool" / folder / "3-trial.jsonl.gz.part").write_bytes(b"half a game")
    kill(here)
    here.wait("STOPPED")
    assert (here.data / folder / "3-trial.jsonl.gz").read_bytes() == b"half a game"


def test_the_desktops_variable_SESSION_makes_no_session(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SESSION", "ubuntu")
    tasks = here.tasks()
    assert "SESSION" not in tasks._shared.environment(request())
    assert tasks._shared.environment(request(SESSION=SESSION))["SESSION"] == SESSION


def test_a_shells_variable_GROUP_is_no_participants_group(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GROUP", "users")
    tasks = here.tasks()
    assert "GROUP" not in tasks._shared.environment(request(WARM_SERVER="on"))
    assert tasks._shared.environment(request(GROUP="1"))["GROUP"] == "1"


def test_a_recording_is_not_kept_if_the_study_keeps_none(here: Here) -> None:
    folder = f"study/users/P1/trials/{NAME}"
    tasks = here.tasks(stop_timeout=0.2)
    tasks.add_project("study", here.project, keeps_recordings=False)
    arn = tasks.run(request(FAKE_STUBBORN="yes"))
    here.wait("RUNNING")
    (here.state / "spool" / folder).mkdir(parents=True)
    (here.state / "spool" / folder / "3-trial.jsonl.gz.part").write_bytes(b"half a game")
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    here.wait("STOPPED")
    assert not (here.data / folder).exists()


# --- warm servers, which get their participant only later

OWN = "saaaaaaaaaaaaaaaaaaab-3"
SESSION = "s.0123456789abcdef0123"
PLAYED = f"study/users/P1/trials/{OWN}"


def warm_server_request(**environment: str) -> TaskRequest:
    told = request(WARM_SERVER="on", SERVER=NAME, **environment)
    return replace(told, environment={key: value for key, value in told.environment.items() if key != "USER_ID"})


def give(here: Here) -> Path:
    """Write the handover, as the control plane does when a participant takes the warm server."""
    document = here.data / f"study/handovers/{NAME}.json"
    document.parent.mkdir(parents=True)
    document.write_bytes(Handover("P1", None, OWN).to_json())
    return document


def half_a_game(here: Here) -> None:
    (here.state / "spool" / PLAYED).mkdir(parents=True)
    (here.state / "spool" / PLAYED / "3-trial.jsonl.gz.part").write_bytes(b"half a game")


def kill(here: Here) -> None:
    """Kill the server's own process, as the kernel does when memory runs out."""
    [server] = marked(here.state)[NAME]
    os.kill(server.pid, signal.SIGKILL)


def test_a_recording_of_a_killed_warm_server_is_kept_where_its_participants_are(here: Here) -> None:
    here.tasks().run(warm_server_request())
    here.wait("RUNNING")
    give(here)
    half_a_game(here)
    kill(here)
    here.wait("STOPPED")
    assert (here.data / PLAYED / "3-trial.jsonl.gz").read_bytes() == b"half a game"


def test_a_recording_of_a_warm_server_in_a_session_is_kept_with_the_session(here: Here) -> None:
    tasks = here.tasks()
    tasks.run(warm_server_request())
    here.wait("RUNNING")
    give(here).write_bytes(Handover(SESSION, None, OWN).to_json())
    assert [(task.folder, task.server) for task in tasks.playing()] == [(f"study/sessions/{SESSION}", OWN)]


def test_the_document_of_a_warm_server_may_be_deleted_before_its_process_ends(here: Here) -> None:
    tasks = here.tasks(stop_timeout=0.5)
    arn = tasks.run(warm_server_request(FAKE_STUBBORN="yes"))
    here.wait("RUNNING")
    document = give(here)
    half_a_game(here)
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    document.unlink()  # the control plane deletes it after the stop
    here.wait("STOPPED")
    assert (here.data / PLAYED / "3-trial.jsonl.gz").read_bytes() == b"half a game"


@pytest.mark.parametrize("document", [None, b"", b'{"userId": "P1", "ser', b'{"userId": "../P1", "server": "a-1"}'])
def test_a_warm_server_without_a_participant_has_no_folder_and_no_recordings(
    here: Here, document: bytes | None
) -> None:
    tasks = here.tasks()
    arn = tasks.run(warm_server_request())
    here.wait("RUNNING")
    if document is not None:
        give(here).write_bytes(document)
    assert [task.folder for task in tasks.playing()] == [""]
    tasks.stop(arn, "hippodrome", "hippodrome: enough")
    assert here.wait("STOPPED")["containers"][0]["exitCode"] == 0
    assert not (here.data / "study/users").exists()


AGENT = """
import numpy
class Agent:
    def start(self, game): self.n = 0
    def reset(self, seed=None): self.n = 0
    def step(self, action): return 0, 1.0, False, False, {}
    def render(self): return numpy.zeros((8, 8, 3), numpy.uint8)
    def close(self): pass
"""


def test_a_game_on_a_warm_server_that_is_killed_can_be_read(here: Here) -> None:
    """With the real trial server, and a participant on it."""
    (here.project / "agent.py").write_text(AGENT)
    trial = {"game": "none", "actionSpace": ["noop"], "startingFrameRate": 60}
    told = warm_server_request(GAME_STEPS="3", TRIAL=json.dumps(trial))
    tasks = here.tasks(command=tasks_module.PYTHON_TRIAL)
    tasks.run(told)
    here.wait("RUNNING", seconds=30)
    [port] = [task.port for task in tasks.playing()]
    give(here)
    with connect(f"ws://127.0.0.1:{port}/", proxy=None) as player:
        player.send(json.dumps({"userId": "P1", "token": "secret", "step": "3"}))
        assert "actionSpace" in json.loads(player.recv(60))
        player.send('{"command": "start"}')
        [part] = (here.state / "spool").rglob("*.part")
        while [line["kind"] for line in recording.read(part.read_bytes())].count("step") <= 20:
            player.recv(60)
        kill(here)
    stopped = here.wait("STOPPED")
    assert stopped["containers"][0]["exitCode"] == 137
    assert "the process was killed" in stopped["stoppedReason"], "and not that its memory was full"
    [file] = (here.data / PLAYED).iterdir()
    lines = recording.read(file.read_bytes())
    assert lines[0]["userId"] == "P1"
    assert [line["kind"] for line in lines].count("step") > 20
    assert not list((here.state / "spool").rglob("*.part"))


def test_close_ends_all_servers_and_starts_none(here: Here) -> None:
    tasks = here.tasks(stop_timeout=600)
    names = [f"s{'a' * 20}-{n}" for n in range(1, 6)]
    for n, name in enumerate(names):
        tasks.run(request(name, **({"FAKE_STUBBORN": "yes"} if n == 0 else {})))
    for name in names:
        here.wait("RUNNING", name)
    began = time.monotonic()
    tasks.close(1)
    assert time.monotonic() - began < 20, "the stubborn one has a second here, and else ten minutes"
    until(lambda: not here.processes())  # SIGKILL was sent to all, and takes a moment to have its effect
    for name in names:
        here.wait("STOPPED", name, 0)
    with pytest.raises(RuntimeError):
        tasks.run(request("saaaaaaaaaaaaaaaaaaaa-99"))


def test_old_logs_are_deleted(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tasks_module, "KEPT_LOGS", 2)
    tasks = here.tasks()
    names = [f"s{'a' * 20}-{n}" for n in range(1, 6)]
    for name in names:
        tasks.run(request(name, FAKE_SECONDS="0"))
        here.wait("STOPPED", name)
    tasks.close()
    here.tasks().clear()
    assert sorted(path.stem for path in (here.state / "logs").iterdir()) == names[3:]
