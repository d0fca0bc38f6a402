"""After an update, secrets of an earlier version are removed from the list of projects, which researchers can read."""

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
from tests.deploy.registering import RegisterWorld


def hide(register_world: RegisterWorld) -> None:
    account = open_account(region=register_world.region)
    register_function.hide_secrets(account, find_installation(account, STACK))


def test_secrets_of_an_earlier_version_are_removed_from_the_list(
    register_world: RegisterWorld, capsys: pytest.CaptureFixture[str]
) -> None:
    register_world.register(
        study(secret="of-old"), msgspec.structs.replace(study(), id="other", secret="others-of-old")
    )
    hide(register_world)
    assert b"of-old" not in register_world.get(MASTER_LIST)
    assert "2 secrets of an earlier version went out" in capsys.readouterr().err
    found = ProjectCache(register_world.platform, SecretCache(register_world.platform.documents)).project("maze")
    assert found
    assert found.secret == "of-old"


def test_without_such_secrets_the_function_is_not_called(
    register_world: RegisterWorld, capsys: pytest.CaptureFixture[str]
) -> None:
    hide(register_world)
    register_world.register(study(secret="", salt="s"))
    hide(register_world)
    assert "lambda:Invoke" not in register_world.made
    assert KEY not in list(register_world.keys())
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("trouble", ["function", "list", "old"])
def test_a_failure_says_that_the_next_registration_moves_the_secrets(
    register_world: RegisterWorld, capsys: pytest.CaptureFixture[str], monkeypatch: Any, trouble: str
) -> None:
    register_world.register(study(secret="of-old"))
    if trouble == "function":
        register_world.function_error = True
    elif trouble == "list":
        register_world.put(MASTER_LIST, b"{")
    else:
        monkeypatch.setattr("lambdas.update_project_master_list.handler", lambda *_: {"problems": ["steps: missing"]})
    hide(register_world)
    assert "the next `register` moves them" in " ".join(capsys.readouterr().err.split())
