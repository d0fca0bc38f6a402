"""The known name that was probably meant by an unknown one."""

from __future__ import annotations

import pytest

from hippodrome.protocol.similar import SIMILAR_FILES, did_you_mean, nearest


@pytest.mark.parametrize(
    ("name", "known", "meant"),
    [
        ("fsp", ["fps", "state_init"], "fps"),
        ("MAXEPISODES", ["maxEpisodes", "maxSteps"], "maxEpisodes"),
        ("maxEpisode", ["maxEpisodes", "maxSteps"], "maxEpisodes"),
        ("secret", ["steps", "seed"], None),
        ("anything", [], None),
    ],
)
def test_the_most_similar_name_is_meant_if_it_is_similar_enough(name: str, known: list[str], meant: str | None) -> None:
    assert nearest(name, known) == meant


def test_names_of_files_must_be_more_similar() -> None:
    assert nearest("thank", ["thanks"], SIMILAR_FILES) == "thanks"
    assert nearest("banks", ["thanks"]) == "thanks"
    assert nearest("banks", ["thanks"], SIMILAR_FILES) is None


def test_a_message_asks_whether_the_similar_name_was_meant() -> None:
    assert did_you_mean("Idel", ["human", "idle"]) == "; did you mean idle?"
    assert did_you_mean("nobody", ["human", "idle"]) == ""
