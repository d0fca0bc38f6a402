"""Ctrl-C ends a block only where the block can be ended."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

import pytest

from hippodrome.export.interruption import interruption


@pytest.fixture(autouse=True)
def default_handler() -> Iterator[None]:
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


class Ended(Exception):
    pass


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_it_ends_the_block_where_the_block_can_be_ended() -> None:
    with contextlib.suppress(Ended), interruption() as check:
        check()
        press()
        with pytest.raises(KeyboardInterrupt):
            check()
        raise Ended


def test_pressed_again_it_ends_the_block_at_once() -> None:
    with contextlib.suppress(Ended), interruption():
        press()
        with pytest.raises(KeyboardInterrupt):
            press()
        raise Ended


def press_in_a_block() -> None:
    with interruption():
        press()


def test_it_ends_the_program_after_the_block() -> None:
    with pytest.raises(KeyboardInterrupt):
        press_in_a_block()


def test_after_the_block_it_is_as_before() -> None:
    with interruption():
        pass
    with pytest.raises(KeyboardInterrupt):
        press()


def test_a_programs_own_handler_stays() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with interruption() as check:
        press()
        check()
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_in_another_thread_nothing_changes() -> None:
    seen = []

    def run() -> None:
        with interruption() as check:
            seen.append(signal.getsignal(signal.SIGINT))
            check()

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert seen == [signal.default_int_handler]
