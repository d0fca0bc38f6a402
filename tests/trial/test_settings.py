"""A server's settings, from its environment and from config.yml."""

import json

import pytest

from hippodrome.trial.settings import SettingsError, TrialSettings, trial_section

ENV = {
    "PROJECT_ID": "p",
    "USER_ID": "u",
    "SERVER": "s.1",
    "TOKEN": "t",
    "GAME_STEPS": "2, 4",
    "STORE": "x",
    "TLS": "off",
}


def test_settings_are_read_from_the_environment():
    found = TrialSettings.from_env(
        {**ENV, "TRIAL": json.dumps({"ui": {"left": True, "up": False}, "actionSpace": ["NOOP", "Left"]})}
    )
    assert found.game_steps == ("2", "4")
    assert found.trial.ui.shown() == ("left",)
    assert found.trial.action_space == ("noop", "left")
    assert (found.port, found.idle_seconds, found.grace_seconds, found.deadline) == (5000, 600, 60, None)
    assert "'t'" not in repr(found)
    assert [TrialSettings.from_env({**ENV, "GROUP": text}).group for text in ("", "0", "12")] == [None, 0, 12]


def test_the_trial_section_of_config_yml_is_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert TrialSettings.from_env(ENV).trial == trial_section({})
    (tmp_path / "config.yml").write_text(
        "project: {}\ntrial:\n  game: X-v1\n  maxEpisodes: 3\n  allowFramRateChange: true\n"
    )
    found = TrialSettings.from_env(ENV).trial
    assert (found.game, found.max_episodes, found.allow_frame_rate_change) == ("X-v1", 3, True)
    for text in ("trial: [1]", "trial: {maxEpisodes: none}", ": : :"):
        (tmp_path / "config.yml").write_text(text)
        with pytest.raises(SettingsError):
            TrialSettings.from_env(ENV)


@pytest.mark.parametrize(
    "change",
    [
        {"PROJECT_ID": "../x"},
        {"STORE": "s3://bucket"},
        {"STORE": "https://sign.example.org"},  # without a credential
        {"USER_ID": ""},
        {"SERVER": "a/b"},
        {"TOKEN": ""},
        {"GAME_STEPS": "a/b"},
        {"GAME_STEPS": ","},
        {"PORT": "70000"},
        {"PORT": "x"},
        {"GROUP": "a"},
        {"GROUP": "-1"},
        {"TLS": "maybe"},
        {"TLS": "on"},
        {"DEADLINE": "nan"},
        {"IDLE_SECONDS": "-1"},
        {"TRIAL": "{"},
        {"TRIAL": "[]"},
        {"TRIAL": '{"maxEpisodes": 0}'},
        {"TRIAL": '{"maxEpisodes": true}'},
        {"TRIAL": '{"minFrameRate": 50, "maxFrameRate": 20}'},
        {"TRIAL": '{"startingFrameRate": 500}'},
        {"TRIAL": '{"dataFile": "both"}'},
        {"TRIAL": '{"actionSpace": ["a", "A"]}'},
        {"TRIAL": '{"actionSpace": "up"}'},
        {"TRIAL": '{"ui": ["left"]}'},
        {"TRIAL": '{"s3upload": "maybe"}'},
        {"TRIAL": '{"game": 3}'},
    ],
)
def test_wrong_settings_are_refused(change):
    with pytest.raises(SettingsError):
        TrialSettings.from_env({**ENV, **change})
