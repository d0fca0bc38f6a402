"""examples/assistant: the owl is told where everything is, and a bot comes to the end."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np


def test_whoever_follows_the_words_finds_all_acorns(load_module: Any) -> None:
    grove_module = load_module("assistant", "grove")
    moves = {"up": 0, "right": 1, "down": 2, "left": 3}
    for seed in range(30):
        grove = grove_module.Grove(seed)
        while grove.hidden:
            _, first, *_ = grove.in_words().splitlines()
            for part in first.removeprefix("- an acorn ").split(" and "):
                number, way = part.split(" ")
                for _ in range(int(number)):
                    grove.move(moves[way])
        assert grove.in_words().endswith("- no acorn is left")


def test_the_squirrel_sees_only_acorns_beside_it(load_module: Any) -> None:
    grove = load_module("assistant", "grove").Grove(1)
    assert grove.seen() == []
    column, row = min(grove.hidden)
    grove.squirrel = (column, row + 1)
    assert (column, row) in grove.seen()


def test_the_owl_gets_the_question_the_grove_and_what_was_said(load_module: Any) -> None:
    load_module("assistant", "grove")
    load_module("assistant", "picture")
    agent = load_module("assistant", "agent").Agent()
    agent.start("grove")
    agent.reset(1)
    asked: list[str] = []
    talk = [{"by": "player_0", "text": "Hello"}, {"by": "ai", "text": "Hoo"}, {"by": "player_0", "text": "Where?"}]
    session = SimpleNamespace(talk=talk, ask=lambda text: asked.append(text) or "There")
    assert agent.reply(session, "player_0", "Where?") == "There"
    (text,) = asked
    assert text.startswith("The squirrel asks: Where?\n\nFrom the squirrel, which has 24 moves left:\n- an acorn ")
    assert text.endswith("\n\nSaid before:\nplayer_0: Hello\nai: Hoo")


def test_a_bot_plays_two_groves(play_example: Any) -> None:
    played = play_example("assistant", betweenEpisodes=0)
    assert [len(lines) > 2 for lines in played.recordings] == [True, True]
    assert np.isfinite(played.result["score"])
