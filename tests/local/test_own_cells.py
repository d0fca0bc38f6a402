"""The links by which a researcher tries the cells of `conditions` on one machine."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hippodrome.functions import installed, next_step
from hippodrome.local.own_cells import OwnCells
from hippodrome.protocol.keys import membership_key
from testing.designed import DesignedStudy, write
from testing.fake_platform import FakePlatform
from tests.control.test_designs import ABOUT, PAGES, PAIRS, SOUP
from tests.local.conftest import Local


def asked(**query: str) -> dict[str, Any]:
    """A request for a page with these fields."""
    text = "&".join(f"{name}={value}" for name, value in query.items())
    http = {"method": "GET", "path": "/next"}
    return {
        "rawPath": "/next",
        "rawQueryString": text,
        "queryStringParameters": query,
        "headers": {"accept": "text/html"},
        "requestContext": {"http": http},
    }


@pytest.fixture
def platform(tmp_path: Path) -> FakePlatform:
    platform = FakePlatform()
    installed.use(platform)
    folder = write(tmp_path / "soup", SOUP, PAGES)
    (folder / "policies").mkdir()
    for level in ("helpful", "lazy"):
        (folder / "policies" / f"{level}.onnx").touch()
    DesignedStudy(folder, platform)
    return platform


def condition(platform: FakePlatform, user: str, project: str = "soup") -> dict[str, str] | None:
    found = platform.documents.get(f"{project}/users/{user}/assignment.json")
    return json.loads(found.body)["condition"] if found else None


def test_a_link_with_a_cell_gives_this_cell_to_a_new_participant(platform: FakePlatform) -> None:
    here = OwnCells(platform, next_step.handler).handler
    assert here(asked(projectId="soup", userId="ada", cell="lazy,on"), None)["statusCode"] == 200
    assert condition(platform, "ada") == {"partner": "lazy", "advice": "on"}
    here(asked(projectId="soup", userId="ada", cell="helpful,on"), None)
    assert condition(platform, "ada") == {"partner": "lazy", "advice": "on"}


def test_the_links_of_two_who_play_together_give_the_cell_to_their_session(tmp_path: Path) -> None:
    platform = FakePlatform()
    installed.use(platform)
    DesignedStudy(write(tmp_path / "pairs", PAIRS, {**PAGES, **ABOUT}), platform)
    here = OwnCells(platform, next_step.handler).handler
    here(asked(projectId="pairs", userId="ann", cell="best"), None)
    assert platform.documents.get("pairs/users/ann/assignment.json") is None, "nobody knows with whom ann plays"
    membership = json.dumps({"session": "s." + 24 * "a", "members": 2, "players": 2}).encode()
    for user in ("ann", "ben"):
        platform.documents.put(membership_key("pairs", user), membership)
        here(asked(projectId="pairs", userId=user, cell="best"), None)
        assert condition(platform, user, "pairs") == {"pay": "best"}


def test_on_aws_nobody_can_choose_their_cell(platform: FakePlatform) -> None:
    assert next_step.handler(asked(projectId="soup", userId="ada", cell="lazy,on"), None)["statusCode"] == 200
    assert condition(platform, "ada") is None


def test_a_cell_that_is_not_there_is_refused_with_those_that_are(platform: FakePlatform) -> None:
    refused = OwnCells(platform, next_step.handler).handler(asked(projectId="soup", userId="ada", cell="lazy"), None)
    assert refused["statusCode"] == 404
    assert "helpful,on; helpful,off; lazy,on; lazy,off" in refused["body"]


def test_run_prints_a_link_for_each_of_the_first_cells(local: Callable[..., Local]) -> None:
    held = local(start=2)
    config = held.folder / "config.yml"
    config.write_text(config.read_text().replace("project:\n", "project:\n  conditions: {tone: 15}\n", 1))
    held.run()
    said = held.wait_for_text(r"To try a cell yourself \(tone\)(.|\n)*Ctrl-C")[0]
    assert re.findall(r"cell=(\d+)", said) == [*map(str, range(1, 13)), "15"]
    assert "… and 3 more" in said
