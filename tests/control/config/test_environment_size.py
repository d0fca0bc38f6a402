"""The environment of a server fits into the 8,192 characters that ECS allows, or the study is not registered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from hippodrome.control.aws.tasks import EcsTasks
from hippodrome.control.config import ConfigErrors, parse_registration
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.ports import Refused, TaskRequest
from testing.servers import Servers
from testing.studies import installed

LONG = "i" * 64
MAX_ADDRESS = f"https://{'s' * 63}.{'d' * 200}/sign"  # the template's SiteHost and RootDomain
Make = Callable[[int], dict[str, Any]]


def message(trial: dict[str, Any], games: int = 1, **project: Any) -> dict[str, Any]:
    """Return a registration with the longest possible id."""
    pages = ["game"] * games + ["bye"]
    steps = [{"key": str(number), "page": page} for number, page in enumerate(pages, 1)]
    return {"id": LONG, "steps": steps, "trial": {"game": "x/Y-v0", **trial}, **project}


def request_of(registration: dict[str, Any]) -> TaskRequest:
    """Return the request to ECS for the server of a participant with the longest possible id."""
    steps = [{**step, "variants": 0} for step in registration["steps"]]
    kept = {"id": LONG, "name": "n", "live": True, "secret": "s", "awsSetup": {"cpu": 16, "memory": 120}}
    project = from_json(
        to_json(
            {
                **{key: registration[key] for key in ("maxRuntime", "events", "trial")},
                **{key: registration[key] for key in ("subdomain", "plainClients", "frontEnd")},
                **kept,
                "steps": steps,
            }
        ),
        Project,
    )
    platform = installed(project)
    platform.settings = replace(platform.settings, plain_clients=True)
    Servers(platform).start(StartServer(LONG, "u" * 64))
    (request,) = platform.tasks.running.values()
    environment = {**request.environment, "GROUP": "999"}
    return TaskRequest("s" + "a" * 20 + "-99", "d", "c", 16, 120, environment)


def ecs_takes(request: TaskRequest) -> bool:
    class Taken(Exception):
        pass

    def ecs() -> Any:
        raise Taken

    try:
        EcsTasks(ecs, ecs, lambda name: MAX_ADDRESS if name == "SIGN_URL" else "b" * 63).run(request)
    except Taken:
        return True
    except Refused:
        return False
    raise AssertionError


MAKES: dict[str, tuple[Make, str]] = {
    "many actions": (lambda n: {"actionSpace": [f"action-{k}-{'a' * 40}" for k in range(n)]}, "actionSpace"),
    "short actions": (lambda n: {"actionSpace": [str(k) for k in range(n)]}, ""),
    "actions beyond ASCII": (lambda n: {"actionSpace": [f"{k}{'é' * 40}" for k in range(n)]}, "actionSpace"),
    "options of backslashes": (lambda n: {"options": {"a": "\\" * n}}, "options"),
    "options of quotes": (lambda n: {"options": {"a": [""] * n}}, ""),
    "many policies": (
        lambda n: {"players": {"p": "human", **{f"p{k}": f"{'a' * 190}.onnx" for k in range(n)}}},
        "players",
    ),
    "a game beyond ASCII": (lambda n: {"game": "é" * 500, "options": {"a": "é" * n}}, "game"),
}


@pytest.mark.parametrize("name", MAKES)
def test_a_registration_is_accepted_exactly_if_ecs_takes_its_environment(name: str) -> None:
    make, key = MAKES[name]
    accepted, refused, words = 1, 5000, ""
    while refused - accepted > 1:  # the largest section that is accepted
        middle = (accepted + refused) // 2
        try:
            parse_registration(message(make(middle)))
            accepted = middle
        except ConfigErrors as error:
            refused, words = middle, str(error)
    assert ecs_takes(request_of(parse_registration(message(make(accepted)))))
    if key:
        assert f"trial.{key}: " in words
        assert "8192" in words


def test_all_variables_of_a_server_count_together() -> None:
    trial = {"actionSpace": [f"action-{k}-{'a' * 40}" for k in range(98)]}
    aws = {"useAWS": True, "awsSetup": {"cpu": 1, "memory": 2}}
    assert ecs_takes(request_of(parse_registration(message(trial, **aws))))
    assert ecs_takes(request_of(parse_registration(message({}, games=450, **aws))))
    with pytest.raises(ConfigErrors, match=r"trial\.actionSpace: .*8192"):
        parse_registration(message(trial, games=450, **aws))


def test_the_addresses_of_a_front_end_count() -> None:
    own = {"subdomain": "userId", "plainClients": True}
    ends = {**own, "frontEnd": [f"https://{n}{'a' * 60}.{'.'.join(['b' * 60] * 2)}.org" for n in range(5)]}
    actions = [f"action-{k}-{'a' * 40}" for k in range(90)]
    taken = parse_registration(message({"actionSpace": actions}, **ends))
    assert ecs_takes(request_of(taken))
    with pytest.raises(ConfigErrors, match="8192"):
        parse_registration(message({"actionSpace": [f"action-{k}-{'a' * 40}" for k in range(104)]}, **ends))


def test_a_section_a_little_below_the_limit_is_accepted() -> None:
    """The check leaves little of ECS's limit unused."""
    actions = [f"action-{k}-{'a' * 40}" for k in range(107)]
    assert ecs_takes(request_of(parse_registration(message({"actionSpace": actions}))))
