"""`update_project_master_list` registers projects in the master list."""

from __future__ import annotations

import json
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import pytest

from hippodrome.control.model.project import MASTER_LIST, MasterList
from hippodrome.control.model.records import from_json
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import installed as place
from hippodrome.functions import update_project_master_list
from testing.fake_platform import FakePlatform


def registration(project_id: str = "maze", **changes: object) -> dict[str, Any]:
    return {
        "id": project_id,
        "name": "A maze",
        "live": True,
        "maxRuntime": 30,
        "useAWS": False,
        "events": {"startServerStep": "1", "stopServerStep": None},
        "steps": [{"key": "1", "page": "consent", "variants": 2}, {"key": "finalStep", "page": "bye", "variants": 0}],
        "trial": {},
        **changes,
    }


@pytest.fixture
def platform() -> FakePlatform:
    platform = FakePlatform()
    for project in ("maze", "other", *(f"p{n}" for n in range(12))):
        for file in ("consent-0", "consent-1", "bye"):
            platform.documents.put(f"{project}/steps/{file}.html", b"x")
    place.use(platform)
    return platform


def register(project: object) -> dict[str, Any]:
    return update_project_master_list.handler({"project": project}, None)


def listed(platform: FakePlatform) -> MasterList:
    return from_json(platform.documents.kept[MASTER_LIST][0], MasterList)


def secret(platform: FakePlatform, project_id: str = "maze") -> str:
    """Return the secret that signs the project's tickets, as functions read it."""
    project = ProjectCache(platform, SecretCache(platform.documents)).project(project_id)
    assert project
    return project.secret


def test_a_project_is_added_and_later_replaced(platform: FakePlatform) -> None:
    assert register(registration())["registered"] == "maze"
    register(registration("other"))
    register(registration(name="A better maze", live=False))
    assert [(p.id, p.name, p.live) for p in listed(platform).projects] == [
        ("maze", "A better maze", False),
        ("other", "A maze", True),
    ]


def test_a_registered_projects_secret_stays_so_that_codes_and_open_pages_stay_valid(platform: FakePlatform) -> None:
    register(registration())
    before = secret(platform)
    register(registration(name="new"))
    assert len(before) == 64
    assert secret(platform) == before


def test_two_researchers_at_once_are_both_registered(platform: FakePlatform) -> None:
    platform.documents.before_write.append(lambda: register(registration("other")))
    assert "registered" in register(registration())
    assert {p.id for p in listed(platform).projects} == {"maze", "other"}


def test_many_researchers_at_once_are_all_registered(platform: FakePlatform) -> None:
    lock = threading.Lock()
    replace, create = platform.documents.replace, platform.documents.create

    def locked(act: Any) -> Any:
        def call(*args: Any) -> Any:
            with lock:
                return act(*args)

        return call

    platform.documents.replace, platform.documents.create = locked(replace), locked(create)  # type: ignore[method-assign]
    with ThreadPoolExecutor(12) as pool:
        list(pool.map(lambda n: register(registration(f"p{n}")), range(12)))
    assert {p.id for p in listed(platform).projects} == {f"p{n}" for n in range(12)}


def test_a_page_that_was_not_uploaded_is_named(platform: FakePlatform) -> None:
    platform.documents.delete("maze/steps/consent-1.html")
    assert register(registration()) == {"problems": ["project.steps.1: consent-1.html has not been uploaded"]}
    assert MASTER_LIST not in platform.documents.kept


def test_a_page_of_the_game_that_was_not_uploaded_is_named(platform: FakePlatform) -> None:
    told = registration(trial={"game": "x/Y-v0", "instructions": "rules"}, gamePages={"instructions": 2})
    told["events"]["stopServerStep"] = "finalStep"
    told["steps"].insert(1, {"key": "2", "page": "game", "variants": 0})
    assert register(told) == {
        "problems": [f"trial.instructions: rules-{number}.html has not been uploaded" for number in (0, 1)]
    }


@pytest.mark.parametrize("pages", [{"betweenEpisodes": 1}, {"instructions": -1}, {"instructions": "2"}, [], None])
def test_groups_of_pages_that_the_trial_does_not_name_are_refused(platform: FakePlatform, pages: object) -> None:
    told = registration(trial={"instructions": "rules"}, gamePages=pages)
    (problem,) = register(told)["problems"]
    assert problem.startswith("gamePages")


@pytest.mark.parametrize("project", [None, [], "x", {}, {"id": "../x"}, {"id": "maze", "steps": "all"}, {"id": 7}])
def test_a_message_that_is_no_project_is_refused_with_a_sentence(platform: FakePlatform, project: object) -> None:
    assert register(project)["problems"]
    assert MASTER_LIST not in platform.documents.kept


def test_a_project_for_another_installation_is_refused(platform: FakePlatform) -> None:
    setup = {"bucket": "elsewhere", "region": "us-east-1", "rootDomain": "example.net", "cpu": 1, "memory": 2}
    ssl = {"sslBucket": "elsewhere", "fullchain": "a.pem", "privkey": "b.pem"}
    problems = register(registration(useAWS=True, awsSetup=setup, ssl=ssl, maxRuntime=600))["problems"]
    assert any("bucket" in p for p in problems)
    assert any("example.net" in p for p in problems)
    assert any("120 minutes" in p or "allows 120" in p for p in problems)


def test_a_warm_server_must_be_able_to_wait_an_hour_before_it_is_played_on(platform: FakePlatform) -> None:
    """Otherwise the warm servers would be replaced again and again."""
    assert platform.settings.max_runtime == 120
    assert "registered" in register(registration(warmServers=2, maxRuntime=60))
    assert "registered" in register(registration(maxRuntime=61))
    (problem,) = register(registration(warmServers=2, maxRuntime=61))["problems"]
    assert problem.startswith("project.warmServers is 2")
    assert "may need 121 minutes, and this installation allows 120" in problem
    # Closing a project is always allowed.
    assert "registered" in register(registration(warmServers=2, maxRuntime=61, live=False))


def test_servers_are_named_after_ids_only_where_that_is_allowed(platform: FakePlatform) -> None:
    assert "problems" not in register(registration(subdomain="userId"))
    platform.settings = replace(platform.settings, user_id_names=False)
    (problem,) = register(registration(subdomain="userId"))["problems"]
    assert "ServerNames" in problem


def test_front_ends_without_tokens_are_registered_only_where_that_is_allowed(platform: FakePlatform) -> None:
    asked = {"subdomain": "userId", "plainClients": True, "frontEnd": ["https://play.example.org"]}
    (problem,) = register(registration(**asked))["problems"]
    assert problem == "project.plainClients is true, which this installation's parameter PlainClients does not allow"
    platform.settings = replace(platform.settings, plain_clients=True)
    assert "problems" not in register(registration(**asked))
    (entry,) = listed(platform).projects
    assert (entry.plain_clients, entry.front_end) == (True, ["https://play.example.org"])


def test_a_list_written_by_hippo_is_read(platform: FakePlatform) -> None:
    hippo = {"projects": [{"id": "old", "live": False, "name": "x", "steps": [], "unknown": 1}]}
    platform.documents.put(MASTER_LIST, json.dumps(hippo).encode())
    register(registration())
    assert {p.id for p in listed(platform).projects} == {"old", "maze"}


def test_a_registration_for_another_number_of_players_keeps_the_one_before(platform: FakePlatform) -> None:
    steps = [
        {"key": "1", "page": "consent", "variants": 2},
        {"key": "2", "page": "game", "variants": 0},
        {"key": "finalStep", "page": "bye", "variants": 0},
    ]
    places = dict.fromkeys(("red", "blue", "green"), "human")
    for players in (2, 3):
        named = dict(list(places.items())[:players])
        asked = registration(players=players, steps=steps, trial={"game": f"for {players}", "players": named})
        assert register(asked)["registered"] == "maze"
    project = ProjectCache(platform, SecretCache(platform.documents)).project("maze")
    assert project is not None
    before = project.for_session(2)
    assert before is not None
    assert (project.trial["game"], before.trial["game"]) == ("for 3", "for 2")


def test_a_study_of_several_participants_cannot_be_registered_again_for_one(platform: FakePlatform) -> None:
    steps = [
        {"key": "1", "page": "consent", "variants": 2},
        {"key": "2", "page": "game", "variants": 0},
        {"key": "finalStep", "page": "bye", "variants": 0},
    ]
    trial = {"game": "lanterns", "players": {"red": "human", "blue": "human"}}
    together = registration(players=2, steps=steps, trial=trial)
    assert register(together)["registered"] == "maze"
    alone = registration(steps=steps, trial={"game": "lanterns"})
    (problem,) = register(alone)["problems"]
    assert "players: 2" in problem
    assert "another project.id" in problem
    assert register(together)["registered"] == "maze"
    assert ProjectCache(platform, SecretCache(platform.documents)).project("maze").players == 2  # type: ignore[union-attr]
