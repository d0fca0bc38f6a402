"""In a clone of HIPPO Gym, pages may load images from the sites that they name."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import read_project
from hippodrome.control.config.hippo_pages import hosts
from hippodrome.control.config.project_keys import MAX_HOSTS
from tests.control.config.folder import SMALL


@pytest.fixture
def page(tmp_path: Path) -> Path:
    return tmp_path / "page.html"


@pytest.mark.parametrize(
    ("html", "found"),
    [
        ('<img src="https://a.example/x.png">', ("https://a.example",)),
        ("<IMG SRC=' HTTPS://A.example:443/x.png '>", ("https://a.example",)),
        ('<img srcset="https://a.example/1 1x, https://b.example:8443/2 2x">', ("https://a.example", "https://b.example:8443")),
        ('<video poster="https://a.example/p"><source src="https://b.example/v">', ("https://a.example", "https://b.example")),
        ('<iframe src="https://a.example/?q"></iframe><img src="https://a.example/y">', ("https://a.example",)),
        ('<img src="http://a.example/x.png"><img src="x.png"><img src="//a.example/x">', ()),
        ('<script src="https://a.example/x.js"></script><link href="https://a.example/x.css">', ()),
        ('<a href="https://a.example">there</a><!-- <img src="https://a.example/"> -->', ()),
        ('<img src="https://nowhere"><img src="https://{{ host }}/a"><img src>', ()),
    ],
)  # fmt: skip
def test_hosts_finds_the_sites_from_which_a_page_loads(page: Path, html: str, found: tuple[str, ...]) -> None:
    page.write_text(html)
    assert hosts([page]) == found


def test_unreadable_pages_name_no_site_and_the_number_of_sites_is_limited(page: Path) -> None:
    page.write_text("".join(f'<img src="https://a{n}.example/">' for n in range(MAX_HOSTS + 1)))
    assert len(hosts([page.with_name("gone.html"), page])) == MAX_HOSTS


def write(folder: Path, pages: str, config: str = SMALL) -> Path:
    (folder / "config.yml").write_text(config)
    (folder / "steps" / "consent.html").write_text('<img src="https://a.example/x.png">')
    (folder / "steps").rename(folder / pages)
    return folder


def test_in_a_clone_the_sites_of_its_pages_are_allowed(folder: Path) -> None:
    found = read_project(write(folder, "StepFiles"))
    assert found.registration()["allowedHosts"] == ["https://a.example"]
    assert [str(remark) for remark in found.remarks] == [
        "config.yml:1: remark: project: allowedHosts is not given: the pages may load from https://a.example, as with "
        "HIPPO Gym"
    ]


def test_a_list_of_allowed_hosts_in_the_configuration_is_not_extended(folder: Path) -> None:
    config = SMALL.replace("  steps:", "  allowedHosts: []\n  steps:")
    found = read_project(write(folder, "StepFiles", config))
    assert (found.registration()["allowedHosts"], found.remarks) == ([], ())


def test_outside_a_clone_no_site_is_allowed_by_itself(folder: Path) -> None:
    found = read_project(write(folder, "steps"))
    assert (found.registration()["allowedHosts"], found.remarks) == ([], ())
