"""Faults of the product's own, put in on purpose: a state machine has to see each of them."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

from testing.fake_platform import FakeDocuments


class Mutation(NamedTuple):
    """What is put in the place of an attribute, and what the machine must say: another failure is not this fault seen."""

    owner: object
    name: str
    mutant: Callable[..., Any]
    sentence: str  # a regular expression


def written_unread(documents: FakeDocuments, key: str, body: bytes, etag: str = "") -> str:
    """A write that asks nothing of what stands there."""
    return documents._write(key, body)


def assert_seen(
    mutation: Mutation,
    machine: type[RuleBasedStateMachine],
    profile: settings,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Run the machine with this fault; it must fail, and say what is wrong."""
    monkeypatch.setattr(mutation.owner, mutation.name, mutation.mutant)  # type: ignore[arg-type]
    with pytest.raises((AssertionError, ExceptionGroup)) as seen:
        run_state_machine_as_test(machine, settings=profile)
    assert any(re.search(mutation.sentence, text) for text in _said(seen.value)), _said(seen.value)


def _said(error: BaseException) -> list[str]:
    """The texts of all assertions that failed, of one example or of several."""
    if isinstance(error, BaseExceptionGroup):
        return [text for one in error.exceptions for text in _said(one)]
    return [str(error)] if isinstance(error, AssertionError) else []
