"""The request to ECS and the environment of the trial server, value by value."""

from __future__ import annotations

from hippodrome.control.model import ids, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.project import AwsSetup, Project
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Server
from hippodrome.control.ports import TaskRequest
from hippodrome.control.storage.secret import SecretCache
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import installed, study

LABEL = ids.server_label("maze", "alice")


def started(project: Project, user: str = "alice") -> tuple[FakePlatform, TaskRequest, Server]:
    """Return a platform with one server, the request to ECS for it, and its record."""
    platform = installed(project)
    Servers(platform).start(StartServer("maze", user))
    (request,) = platform.tasks.running.values()
    record = from_json(platform.documents.kept[server.key(ids.server_label("maze", user))][0], Server)
    return platform, request, record


def test_the_request_for_a_task_has_all_values_of_project_and_record() -> None:
    project = study(task_definition="maze:7", aws_setup=AwsSetup(cpu=4, memory=8), trial={"game": "G", "x": [1]})
    platform, request, record = started(project)
    assert request == TaskRequest(
        name=f"{LABEL}-1",
        definition="maze:7",
        cluster=platform.settings.cluster,
        cpu=4,
        memory=8,
        environment=request.environment,
        spot=True,
        nonce=record.nonce,
        port=5000,
    )
    assert request.environment == {
        "USER_ID": "alice",
        "GROUP": str(ids.group("maze", "alice", 2)),
        "DEADLINE": str(int(record.deadline.timestamp())),
        "PROJECT_ID": "maze",
        "SERVER": f"{LABEL}-1",
        "TOKEN": SecretCache(platform.documents).token(record),
        "CREDENTIAL": SecretCache(platform.documents).get_or_create().credential(f"{LABEL}-1", record.nonce),
        "GAME_STEPS": "3",
        "TRIAL": '{"game":"G","x":[1]}',
        "SSL_FULLCHAIN": "SSL/servers.example.org/fullchain.pem",
        "SSL_PRIVKEY": "SSL/servers.example.org/privkey.pem",
    }
    assert len(request.environment["TOKEN"]) == 48


def test_a_server_listens_on_the_registered_port() -> None:
    _, request, record = started(study(server_port=443))
    assert (request.port, record.port) == (443, 443)


OWN = ["SSL/servers.example.org/fullchain.pem", "SSL/servers.example.org/privkey.pem"]


def certificate_of(request: TaskRequest) -> list[str]:
    """Return the keys of the certificate that the request tells the server to fetch."""
    return [request.environment[f"SSL_{name}"] for name in ("FULLCHAIN", "PRIVKEY")]


def test_a_project_without_its_own_image_runs_the_installations() -> None:
    platform, request, _ = started(study())
    assert request.definition == platform.settings.task_definition


def test_a_repeated_request_is_the_same_request() -> None:
    """RunTask with the same token and other parameters would be refused (ConflictException)."""
    platform, request, record = started(study())
    platform.tasks.by_name.clear()
    Servers(platform).start(StartServer("maze", "alice", 1))
    again = list(platform.tasks.running.values())[-1]
    assert again == request
    assert record.nonce


def test_a_trial_gets_all_its_game_steps() -> None:
    steps = study().steps
    _, request, _ = started(study(steps=[*steps[:3], Step("5", "game"), *steps[3:]]))
    assert request.environment["GAME_STEPS"] == "3,5"


def test_without_groups_the_agent_gets_none() -> None:
    steps = [step for step in study().steps if not step.variants]
    _, request, _ = started(study(steps=steps))
    assert request.environment["GROUP"] == ""


def test_a_warm_server_gets_its_deadline_and_no_participant() -> None:
    platform = FakePlatform()
    warm_server = ids.warm_id("maze", platform.now(), 0)
    _, request, record = started(study(warm_servers=1), warm_server)
    assert {"USER_ID", "GROUP"} & request.environment.keys() == set()
    assert request.environment["WARM_SERVER"] == "on"
    assert int(request.environment["DEADLINE"]) == int(record.deadline.timestamp()) + 30 * 60
