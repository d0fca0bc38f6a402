"""After an update, the list that researchers read holds no secret of an earlier version any more."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from deploy.aws.account import find_installation, open_account
from deploy.core import register_function
from hippodrome.model.project import MASTER_LIST
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.secret import KEY, SecretCache
from testing.studies import study
from tests.deploy.installation import STACK
from tests.deploy.registering import Town, machine, town

__all__ = ["machine", "town"]


def hide(town: Town) -> None:
    account = open_account(region=town.region)
    register_function.hide_secrets(account, find_installation(account, STACK))


def test_secrets_of_an_earlier_version_go_out_of_the_list(town: Town, capsys: pytest.CaptureFixture[str]) -> None:
    town.register(study(secret="of-old"), msgspec.structs.replace(study(), id="other", secret="others-of-old"))
    hide(town)
    assert b"of-old" not in town.get(MASTER_LIST)
    assert "2 secrets of an earlier version went out" in capsys.readouterr().err
    found = ProjectCache(town.platform, SecretCache(town.platform.documents)).project("maze")
    assert found
    assert found.secret == "of-old"


def test_where_there_are_none_nobody_is_asked(town: Town, capsys: pytest.CaptureFixture[str]) -> None:
    hide(town)
    town.register(study(secret="", salt="s"))
    hide(town)
    assert "lambda:Invoke" not in town.made
    assert KEY not in list(town.keys())
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("trouble", ["function", "list", "old"])
def test_what_cannot_be_done_now_is_said(
    town: Town, capsys: pytest.CaptureFixture[str], monkeypatch: Any, trouble: str
) -> None:
    town.register(study(secret="of-old"))
    if trouble == "function":
        town.function_error = True
    elif trouble == "list":
        town.put(MASTER_LIST, b"{")
    else:
        monkeypatch.setattr("lambdas.update_project_master_list.handler", lambda *_: {"problems": ["steps: missing"]})
    hide(town)
    assert "the next `register` moves them" in " ".join(capsys.readouterr().err.split())
