"""Processes that Hippodrome starts find it, as a clone or as a package."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from hippodrome import places


@pytest.fixture
def installed_from(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Let this Python have Hippodrome from a folder, as `pip install --editable` notes it."""
    info = tmp_path / "hippodrome-0.1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: hippodrome\nVersion: 0.1.0\n")
    monkeypatch.syspath_prepend(tmp_path)

    def note(folder: Path) -> None:
        url = {"url": folder.as_uri(), "dir_info": {"editable": True}}
        (info / "direct_url.json").write_text(json.dumps(url))

    return note


def test_a_clone_that_is_installed_needs_no_variable(installed_from) -> None:
    installed_from(places.PACKAGES)
    assert places.for_child({"HOME": "/me"}) == {"HOME": "/me"}


def test_a_clone_beside_the_installed_one_comes_first(installed_from, tmp_path: Path) -> None:
    installed_from(tmp_path / "another clone")
    assert places.for_child({"PYTHONPATH": "mine"})["PYTHONPATH"] == os.pathsep.join([str(places.PACKAGES), "mine"])


def test_the_folder_of_installed_packages_is_never_put_before_the_standard_library(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(places, "IS_CLONE", False)
    assert "PYTHONPATH" not in places.for_child({})
