"""On this machine a stand-in answers if the study's language model has no key; `check` and `try` always use it."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.config import model_cost, read_project
from hippodrome.local.fake_model import FakeModel, behaviour_of, reply_to
from hippodrome.local.stand_in import StandIn

CONFIG = """
project:
  id: s
  {project}
  steps: {steps}
trial:
  game: CartPole-v1
  llm: {{url: "{url}", model: small{more}}}
"""
ONE = "{1: consent, 2: game, 3: bye}"


def study(
    folder: Path, *, url: str = "https://x.example/v1", project: str = "", steps: str = ONE, more: str = ""
) -> Any:
    (folder / "steps").mkdir()
    for page in ("consent", "bye"):
        (folder / "steps" / f"{page}.html").write_text("<p>Page</p>")
    (folder / "config.yml").write_text(CONFIG.format(url=url, project=project, steps=steps, more=more))
    return read_project(folder)


@pytest.mark.parametrize(
    ("url", "key", "always", "used"),
    [
        ("https://x.example/v1", "", False, True),
        ("https://x.example/v1", "sk-1", False, False),
        ("https://x.example/v1", "sk-1", True, True),
        ("http://localhost:11434/v1", "", False, False),
    ],
)
def test_the_stand_in_answers_if_there_is_no_key(tmp_path: Path, url: str, key: str, always: bool, used: bool) -> None:
    env, said = {"LLM_KEY": key}, []
    stand_in = StandIn(always=always, env=env)
    stand_in.use(study(tmp_path, url=url), said.append)
    try:
        assert ("LLM_URL" in env) is used
        assert bool(said) is (used and not always)
        assert env.get("LLM_KEY", "") == ("" if used else key)
    finally:
        stand_in.close()
    assert "LLM_URL" not in env


def ask(model: FakeModel) -> int:
    body = json.dumps({"model": "m", "messages": [{"role": "user", "content": "Hi"}]}).encode()
    request = urllib.request.Request(f"{model.url}/chat/completions", body, {"Content-Type": "application/json"})
    try:
        with urllib.request.urlopen(request) as answer:
            assert json.load(answer)["choices"][0]["message"]["content"] == reply_to("Hi")
            return 200
    except urllib.error.HTTPError as error:
        return error.code


def test_what_the_stand_in_does_wrong_is_chosen_by_a_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FAKE_MODEL", "refuse:2, limit:3")
    model = FakeModel()
    assert [ask(model) for _ in range(4)] == [200, 400, 200, 400]
    assert ask(model) == 429
    model.stop()


def test_a_wrong_word_in_the_variable_is_named() -> None:
    with pytest.raises(ValueError, match="FAKE_MODEL has 'slow:3'; it may have delay:N"):
        behaviour_of("delay:1,slow:3")


def test_check_says_what_the_model_can_cost(tmp_path: Path) -> None:
    more = ", maxTokens: 20000, price: {input: 0.5, output: 1.5}"
    found = study(tmp_path, project="maxParticipants: 200", more=more)
    assert model_cost.sentence(found) == (
        "The language model costs about 0.03 at most for each participant, and 6.00 for 200 participants (maxParticipants): "
        "llm.maxTokens in each game, at the higher of the two prices."
    )


def test_each_run_of_a_block_is_a_game(tmp_path: Path) -> None:
    steps = "[consent, {each: {persona: [warm, firm]}, steps: [game]}, bye]"
    more = ', system: "Be {persona}", maxTokens: 1000000, price: {input: 1, output: 2}'
    words = model_cost.sentence(study(tmp_path, steps=steps, more=more))
    assert words is not None
    assert words.startswith("The language model costs about 4.00 at most for each participant:")


def test_without_a_price_nothing_is_said(tmp_path: Path) -> None:
    assert model_cost.sentence(study(tmp_path)) is None
