"""`make run` of a study in which several participants play together: the links that it prints."""

from __future__ import annotations

import re
from collections.abc import Callable
from urllib.request import urlopen

import pytest

from tests.local.check.test_players import AGENT
from tests.local.check.test_sessions import configured
from tests.local.conftest import Local


@pytest.mark.parametrize("signed", [False, True])
def test_make_run_prints_a_link_for_all_and_one_for_each_place(local: Callable[..., Local], signed: bool) -> None:
    held = local(start=2)
    (held.folder / "agent.py").write_text(AGENT)
    configured(held.folder, f"  patience: 60\n  signedLinks: {str(signed).lower()}\n")
    held.run()
    said = held.wait_for_text(r"To play in both places yourself(.|\n)*Ctrl-C")[0]
    links = re.findall(r"http://\S+", said)
    assert len(set(links)) == 2
    for link in links:
        with urlopen(link) as answer:
            assert "<h1>hello</h1>" in answer.read().decode()
    assert "in windows side by side" in said
    assert "within 60 seconds" in said


@pytest.mark.parametrize("signed", [False, True])
def test_each_cell_has_a_link_for_each_place(local: Callable[..., Local], signed: bool) -> None:
    held = local(start=2)
    (held.folder / "agent.py").write_text(AGENT)
    configured(held.folder, f"  conditions: {{tone: [warm, cold]}}\n  signedLinks: {str(signed).lower()}\n")
    held.run()
    said = held.wait_for_text(r"To try a cell yourself \(tone\)(.|\n)*Ctrl-C")[0]
    links = re.findall(r"http://\S+", said)
    assert [link.partition("&cell=")[2] for link in links] == ["warm", "warm", "cold", "cold"]
    assert len(set(links)) == 4
    for link in links:
        with urlopen(link) as answer:
            assert "<h1>hello</h1>" in answer.read().decode()


@pytest.mark.parametrize("signed", [False, True])
def test_the_links_are_of_participants_who_may_play_together(local: Callable[..., Local], signed: bool) -> None:
    held = local(start=2)
    (held.folder / "agent.py").write_text(AGENT)
    page = held.folder / "steps/hello.html"
    for group in range(8):
        page.with_name(f"hello-{group}.html").write_text(f"<h1>group {group}</h1>")
    page.unlink()
    configured(held.folder, f"  matching: group\n  signedLinks: {str(signed).lower()}\n")
    held.run()
    links = re.findall(r"http://\S+", held.wait_for_text(r"To play in both places yourself(.|\n)*Ctrl-C")[0])
    assert len({re.findall("<h1>.*</h1>", urlopen(link).read().decode())[0] for link in links}) == 1
