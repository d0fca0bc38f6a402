"""Deliberate faults in the product: a state machine must notice each of them."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

from testing.fake_platform import FakeDocuments


class Mutation(NamedTuple):
    """The replacement of an attribute, and the message with which the machine must fail; another failure does not count."""

    owner: object
    name: str
    mutant: Callable[..., Any]
    sentence: str  # a regular expression


def written_unread(documents: FakeDocuments, key: str, body: bytes, etag: str = "") -> str:
    """A write that does not check the present version."""
    return documents._write(key, body)


def assert_noticed(
    mutation: Mutation, machine: type[RuleBasedStateMachine], profile: settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Run the machine with this fault; it must fail with the mutation's message."""
    monkeypatch.setattr(mutation.owner, mutation.name, mutation.mutant)  # type: ignore[arg-type]
    with pytest.raises((AssertionError, ExceptionGroup)) as seen:
        run_state_machine_as_test(machine, settings=profile)
    assert any(re.search(mutation.sentence, text) for text in messages_of(seen.value)), messages_of(seen.value)


def messages_of(error: BaseException) -> list[str]:
    """Return the messages of all failed assertions, of one example or of several."""
    if isinstance(error, BaseExceptionGroup):
        return [text for one in error.exceptions for text in messages_of(one)]
    return [str(error)] if isinstance(error, AssertionError) else []
