"""`secret`: stores the key of a language model in the account, and never shows it."""

from __future__ import annotations

import io
from typing import Any

import pytest

from hippodrome.console.problem import Exit
from hippodrome.control.model.design import Section, Step
from hippodrome.deployment.operate import secret
from testing.iam.actions import Ask
from testing.iam.enforcement import account_of
from testing.iam.judge import MISSING, Judge, evaluator
from testing.studies import study
from tests.deployment.registering import RegisterWorld

KEY = "sk-proj-0123456789abcdef"
PARAMETER = "/hippodrome/hippodrome/LLM_KEY"
Capsys = pytest.CaptureFixture[str]


@pytest.fixture
def given(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return what puts a text on stdin."""
    return lambda text: monkeypatch.setattr("sys.stdin", io.StringIO(text))


def held(world: RegisterWorld) -> dict[str, Any]:
    found: dict[str, Any] = world.client("ssm").get_parameter(Name=PARAMETER, WithDecryption=True)["Parameter"]
    return found


def test_a_key_is_stored_encrypted_listed_by_its_name_replaced_and_removed(
    register_world: RegisterWorld, capsys: Capsys, given: Any
) -> None:
    given(f"{KEY}\n")
    first = register_world.run(capsys, "secret", "set", "LLM_KEY")
    assert (first.code, first.out, "LLM_KEY is stored" in first.err) == (Exit.DONE, "", True)
    assert (held(register_world)["Value"], held(register_world)["Type"]) == (KEY, "SecureString")
    listed = register_world.run(capsys, "secret", "list")
    assert "LLM_KEY" in listed.out
    given("sk-another")
    second = register_world.run(capsys, "secret", "set", "LLM_KEY")
    assert "LLM_KEY has its new value" in second.err
    assert "Servers that run now keep what they had until they end." in second.err
    assert held(register_world)["Value"] == "sk-another"
    (named,) = register_world.run(capsys, "secret", "list", "--json").json
    assert named["name"] == "LLM_KEY"
    removed = register_world.run(capsys, "secret", "remove", "LLM_KEY")
    assert "No server of a study with trial.llm can start" in removed.err
    assert "There are no secrets." in register_world.run(capsys, "secret", "list").out
    again = register_world.run(capsys, "secret", "remove", "LLM_KEY")
    assert (again.code, "There was no LLM_KEY." in again.err) == (Exit.DONE, True)
    for ran in (first, listed, second, removed):
        assert "sk-" not in ran.out + ran.err


def test_a_terminal_is_asked_without_echo(
    register_world: RegisterWorld, capsys: Capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def getpass(prompt: str) -> str:
        asked.append(prompt)
        return KEY

    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(secret.getpass, "getpass", getpass)
    assert register_world.run(capsys, "secret", "set", "LLM_KEY").code == Exit.DONE
    assert asked == ["LLM_KEY (not shown): "]
    assert held(register_world)["Value"] == KEY


@pytest.mark.parametrize(
    ("arguments", "stdin", "says"),
    [
        (["set", "OPENAI_KEY"], KEY, "Unknown secret 'OPENAI_KEY'; expected LLM_KEY."),
        (["set"], KEY, "`set` needs the name of a secret: LLM_KEY."),
        (["list", "LLM_KEY"], "", "`list` takes no name"),
        (["set", f"LLM_KEY={KEY}"], "", "A secret's value is never an argument"),
        (["set", "LLM_KEY"], " \n", "The secret is empty; nothing was stored."),
        (["set", "LLM_KEY"], f"{KEY}\r\nHost: elsewhere", "This is no key; nothing was stored."),
        (["set", "LLM_KEY"], "k" * 4097, "This is no key; nothing was stored."),
        (["set", "LLM_KEY"], "schlüssel", "This is no key; nothing was stored."),
    ],
)
def test_what_is_no_secret_is_refused_and_not_shown(
    register_world: RegisterWorld, capsys: Capsys, given: Any, arguments: list[str], stdin: str, says: str
) -> None:
    given(stdin)
    ran = register_world.run(capsys, "secret", *arguments)
    assert ran.code in (Exit.FAILED, Exit.MISUSE)
    assert says in ran.err
    assert not any(value in ran.out + ran.err for value in (KEY, "kkkk", "schlüssel"))
    assert not [action for action in register_world.made if action.startswith("ssm:")]


def test_the_researchers_policy_allows_the_command(register_world: RegisterWorld, capsys: Capsys, given: Any) -> None:
    if evaluator() is None:
        pytest.skip(MISSING)
    given(KEY)
    for arguments in (["set", "LLM_KEY"], ["list"], ["remove", "LLM_KEY"]):
        assert register_world.run(capsys, "secret", *arguments).code == Exit.DONE
    judge = Judge(account_of(register_world))
    made = {action for action in register_world.made if action.startswith("ssm:")}
    assert made == {"ssm:PutParameter", "ssm:DescribeParameters", "ssm:DeleteParameter"}
    for action in made:
        resource = "*" if "Describe" in action else f"arn:aws:ssm:us-east-1:123456789012:parameter{PARAMETER}"
        assert judge.may("ResearcherPolicy", Ask(action, resource)), action


def test_a_study_needs_the_key_if_any_of_its_games_has_a_language_model() -> None:
    llm = {"llm": {"url": "https://models.example.org/v1", "model": "small"}}
    assert not study().uses_llm
    assert study(trial=llm).uses_llm
    here = {"llm": {"url": "http://localhost:11434/v1", "model": "small"}}
    assert not study(trial=here).uses_llm, "a model on the server itself needs no key"
    of_a_game = Step("talk", "game", sections=(Section(trial=llm),))
    assert study(steps=[of_a_game, Step("bye", "bye")]).uses_llm
