"""Several participants in one environment: which keys go together, and the message for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, parse_registration, read_project
from hippodrome.control.config.remarks import remarks_on
from tests.control.config.folder import mistakes, only_mistake, read, small

TWO = "players: {a: human, b: human}\n"
STEPS = "1: consent\n2: game\n3: thanks\n"
GROUPS = "1: briefing\n2: game\n3: thanks\n"  # briefing-0, briefing-1, briefing-2


def pair(project: str = "", trial: str = TWO, steps: str = STEPS) -> str:
    return small(project=f"players: 2\n{project}", trial=trial, steps=steps)


def remarked(folder: Path, text: str) -> list[str]:
    config = read(folder, text)
    return [
        str(expected).partition("remark: ")[2]
        for expected in remarks_on(folder, config)
        if "useAWS" not in str(expected)
    ]


def test_a_study_of_two_participants_in_one_game_is_read(folder: Path) -> None:
    found = read(folder, pair(project="matching: {same: language}\npatience: 60\n"))
    assert "step 2 is the game (CartPole-v1) for 2 participants together" in found.summary()
    registered = found.registration()
    assert [registered[key] for key in ("players", "matching", "patience", "afterPatience")] == [
        2, {"same": "language"}, 60, "unmatched",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("project", "trial", "expected"),
    [
        (
            "", "",
            "trial.players: missing; project.players is 2, so name the environment's players, 2 of them human, such as "
            "{player_0: human, player_1: human}",
        ),
        (
            "", "players: {a: human, b: random}\n",
            "trial.players: 1 player is human (a), and project.players is 2; write human for 2 of them, or players: 1 "
            "under project",
        ),
        (
            "", "players: {a: human, b: human, c: human}\n",
            "trial.players: 3 players are human (a, b, c), and project.players is 2; write human for 2 of them, or "
            "players: 3 under project",
        ),
        (
            "matching: group\n", "players: {0: {a: human, b: human}, 1: {a: human, b: random}, 2: {a: human, b: human}}\n",
            "trial.players.1: 1 player is human (a), and project.players is 2; write human for 2 of them, or "
            "players: 1 under project",
        ),
        (
            "", "players: {0: {a: human, b: human}, 1: {b: human, a: human}, 2: {a: human, b: human}}\n",
            "trial.players: is given group by group, and a game may have participants of several groups; write "
            "matching: group under project, or one map for all",
        ),
        (
            "afterPatience: policies\n", TWO,
            "trial.substitute: missing; afterPatience: policies needs a policy that plays in the empty places, such as "
            "substitute: random",
        ),
        (
            "", TWO + "afterAbsent: policy\n",
            "trial.substitute: missing; afterAbsent: policy needs a policy that takes the place, such as substitute: "
            "random",
        ),
        (
            "afterPatience: policies\n", TWO + "afterAbsent: policy\n",
            "trial.substitute: missing; afterAbsent: policy needs a policy that takes the place, such as substitute: "
            "random",
        ),
        (
            "", TWO + "substitute: policies/none.onnx\n",
            "trial.substitute: there is no file policies/none.onnx beside agent.py",
        ),
        (
            "plainClients: true\nsubdomain: userId\nfrontEnd: https://play.example.org\n", TWO,
            "project.plainClients: HIPPO's front end opens the game of one participant: write plainClients: false, or "
            "players: 1",
        ),
        (
            "seats: group\n", TWO,
            "project.seats: group, and a game is not of different groups; write matching: mixed or match under project, "
            "or seats: lot",
        ),
        (
            "matching: mixed\nseats: match # by group\n", TWO,
            "project.seats: match, and no function says who plays with whom; write matching: match, or seats: lot",
        ),
        (
            "matching: mixed\nseats: group\nafterPatience: policies\n", TWO + "substitute: random\n",
            "project.seats: group, and with afterPatience: policies a game may lack participants, whose places are always the "
            "last ones; write seats: lot, or afterPatience: unmatched",
        ),
        (
            "seats: first\n", TWO,
            'project.seats: must be lot or group or match, not "first"',
        ),
        (
            "subdomain: userId\n", TWO,
            "project.subdomain: several participants share a server, so it cannot have the id of one as its name: use subdomain: hash",
        ),
        (
            "cluster: participant\n", TWO,
            "project.cluster: several participants share a server, so it cannot run in the cluster of one: use cluster: "
            "installation",
        ),
    ],
)  # fmt: skip
def test_keys_that_do_not_go_together_get_a_message(folder: Path, project: str, trial: str, expected: str) -> None:
    steps = GROUPS if "group" in project or "0:" in trial else STEPS
    assert only_mistake(folder, pair(project, trial, steps)) == expected


def test_each_of_three_groups_has_its_players(folder: Path) -> None:
    trial = "players: {0: {a: human, b: human}, 1: {a: human, b: human, c: random}, 2: {b: human, a: human}}\n"
    assert read(folder, pair("matching: group\n", trial, GROUPS)).project.matching == "group"


GROUP_0, GROUP_1, GROUP_2, GROUP_3 = (f"{number}: {{a: human, b: {plays}}}" for number, plays in enumerate(
    ("random", "idle", "random", "idle")
))  # fmt: skip
THREE = "there are 3 groups, 0 to 2, since a page has 3 versions"


@pytest.mark.parametrize(
    ("steps", "players", "expected"),
    [
        (
            STEPS, (GROUP_0, GROUP_1),
            "trial.players: is given group by group, and there are no groups; write two versions of a page, such as "
            "rules-0.html and rules-1.html, or one map for all",
        ),
        (
            GROUPS, (GROUP_0, GROUP_1, GROUP_2, GROUP_3),
            f"trial.players.3: {THREE}; write a page for this group, such as rules-3.html, or leave the group out",
        ),
        (GROUPS, (GROUP_0, GROUP_2), f"trial.players: does not say who plays in group 1; {THREE}"),
    ],
    ids=["no groups", "a group too many", "a group is missing"],
)  # fmt: skip
def test_players_by_group_name_the_groups_that_the_pages_make(
    folder: Path, steps: str, players: tuple[str, ...], expected: str
) -> None:
    assert only_mistake(folder, small(steps=steps, trial=f"players: {{{', '.join(players)}}}\n")) == expected
    read(folder, small(steps=GROUPS, trial=f"players: {{{GROUP_0}, {GROUP_1}, {GROUP_2}}}\n"))


@pytest.mark.parametrize(("matching", "seats"), [("mixed", "group"), ("match", "group"), ("match", "match")])
def test_seats_may_be_given_by_group_or_by_a_function(folder: Path, matching: str, seats: str) -> None:
    project = read(folder, pair(f"matching: {matching}\nseats: {seats}\n", TWO, GROUPS)).project
    assert (project.matching, project.seats) == (matching, seats)


def test_seats_by_group_need_groups(folder: Path) -> None:
    expected = only_mistake(folder, pair("matching: match\nseats: group\n"))
    assert expected == (
        "project.seats: group, and there are no groups; write two versions of a page, such as rules-0.html and "
        "rules-1.html, or seats: match"
    )


@pytest.mark.parametrize("matching", ["group", "mixed"])
def test_matching_by_groups_needs_groups(folder: Path, matching: str) -> None:
    assert only_mistake(folder, pair(f"matching: {matching}\n")) == (
        f"project.matching: {matching}, and there are no groups; write two versions of a page, such as rules-0.html and "
        "rules-1.html, or matching: arrival"
    )
    read(folder, pair(f"matching: {matching}\n", steps=GROUPS))


@pytest.mark.parametrize("how", ["same", "different"])
def test_the_answer_to_an_earlier_page_may_match(folder: Path, how: str) -> None:
    assert read(folder, pair(f"matching: {{{how}: language}}\n")).project.matching == {how: "language"}


def test_a_function_of_agent_py_may_match(folder: Path) -> None:
    assert read(folder, pair("matching: match\n")).project.matching == "match"


def test_a_registration_is_checked_as_the_file_is(folder: Path) -> None:
    data = read(folder, pair("matching: group\n", steps=GROUPS)).registration()
    assert parse_registration(data)["players"] == 2
    with pytest.raises(ConfigErrors, match="matching: group, and there are no groups"):
        parse_registration({**data, "steps": [{**step, "variants": 0} for step in data["steps"]]})
    with pytest.raises(ConfigErrors, match=r"trial.players: 2 players are human \(a, b\), and project.players is 3"):
        parse_registration({**data, "players": 3})


def test_a_wrong_value_gets_one_message_and_none_about_keys_that_are_compared_with_it(folder: Path) -> None:
    assert only_mistake(folder, pair(trial="players: {a: human, b: nobody}\n")).startswith(
        "trial.players: b must be human,"
    )
    assert only_mistake(folder, pair("matching: groups\n")).startswith("project.matching: must be arrival")
    assert len(mistakes(folder, pair(trial="").replace("players: 2", "players: many"))) == 1


def test_a_complete_study_of_two_participants_gets_no_remark(folder: Path) -> None:
    trial = TWO + "substitute: random\nafterAbsent: policy\ncountdown: 5\nmaxPing: 200\n"
    trial += "episodeSeconds: 240\nbetweenEpisodes: 5\nmaxEpisodes: 3\n"
    assert remarked(folder, pair("patience: 60\nmaxParticipants: 40\nmaxServers: 2\n", trial)) == []


@pytest.mark.parametrize(
    ("project", "trial", "expected"),
    [
        (
            "maxParticipants: 1\n", "",
            "project.maxParticipants: below players, which is 2: a participant finds no other to play with",
        ),
        (
            "maxRuntime: 10\n", "episodeSeconds: 240\nbetweenEpisodes: 5\nmaxEpisodes: 3\n",
            "project.maxRuntime: 10 minutes: the server ends then, and 3 episodes of 240 seconds can take 13",
        ),
        ("", "ui: {stop: true}\n", "trial.ui.stop: one participant who presses it ends the game for all"),
        ("", "ui: {reset: true}\n", "trial.ui.reset: one participant who presses it ends the episode for all"),
        (
            "", "pace: turns\n",
            "trial.turnSeconds: 0: a participant who does nothing keeps the others waiting without end; write "
            "turnSeconds: 20",
        ),
        (
            "", "absent: 0\n",
            "trial.absent: 0: a connection that is lost for a moment ends the game for all; write absent: 30",
        ),
        (
            "", "gather: 0\n",
            "trial.gather: 0: the game ends for the first participant who comes, since nobody waits for the others; "
            "write gather: 120, or afterAbsent: policy with a substitute",
        ),
    ],
)  # fmt: skip
def test_settings_that_may_not_be_intended_get_a_remark(folder: Path, project: str, trial: str, expected: str) -> None:
    assert remarked(folder, pair(project, TWO + trial)) == [expected]


def test_players_without_a_game_have_no_effect(folder: Path) -> None:
    text = "project: {id: paper, players: 2, steps: {1: consent, 2: survey}}\n"
    assert remarked(folder, text) == ["project.players: no effect: no step is game, so no participant plays"]


def test_keys_of_sessions_have_no_effect_for_one_player(folder: Path) -> None:
    text = small(project="patience: 60\nmatching: arrival\n", trial="absent: 10\nsubstitute: random\n")
    why = "no effect: project.players is 1, so each participant plays alone; write players: 2 under project"
    assert sorted(remarked(folder, text)) == [
        f"{key}: {why}" for key in ("project.matching", "project.patience", "trial.absent", "trial.substitute")
    ]


def test_remarks_on_keys_of_sessions_propose_the_number_of_human_players(folder: Path) -> None:
    text = small(project="patience: 60\n", trial="players: {a: human, b: human, c: human}\n")
    expected = [line for line in remarked(folder, text) if line.startswith("project.patience: ")]
    assert expected[0].endswith("; write players: 3 under project")


@pytest.mark.parametrize(
    ("written", "meant"),
    [("Partner", "; a class of agent.py is agent:Partner"), ("randm", "; did you mean random?"), ("a b", "")],
)
def test_a_wrong_policy_gets_a_message_with_a_proposal(folder: Path, written: str, meant: str) -> None:
    (line,) = mistakes(folder, pair(trial=TWO + f"substitute: {written}\n"))
    assert line.endswith(f', not "{written}"{meant}')


def test_a_substitutes_file_is_found(folder: Path) -> None:
    (folder / "policies").mkdir()
    (folder / "policies/partner.onnx").touch()
    read(folder, pair(trial=TWO + "substitute: sample:policies/partner.onnx\n"))
    assert read_project(folder).trial.substitute == "sample:policies/partner.onnx"
