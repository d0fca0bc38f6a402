"""An account in moto whose calls are judged by the evaluator of IAM policies."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hippodrome.functions import installed
from testing.iam.judge import MISSING, evaluator
from testing.moto_world import MotoWorld


@pytest.fixture
def judged() -> None:
    """Skip the test without the evaluator."""
    if evaluator() is None:
        pytest.skip(MISSING)


@pytest.fixture
def world(judged: None) -> Iterator[MotoWorld]:
    """Return the account, which the functions use."""
    with MotoWorld() as made:
        yield made
    installed.use(None)
