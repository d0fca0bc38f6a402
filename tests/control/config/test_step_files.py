"""The steps of config.yml and their pages: the final step, groups, the events around the game."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import remarks
from tests.control.config.folder import SMALL, mistakes, only_mistake, read, small

# The last step


def test_without_final_step_the_last_number_is_final(folder: Path) -> None:
    assert read(folder, SMALL).steps[-1].key == "3"
    assert read(folder, small(project="events: {stopServerStep: finalStep}\n")).events.stop_server_step == "3"


def test_a_final_step_that_repeats_the_last_page_is_the_same_page(folder: Path) -> None:
    steps = "1: consent\n2: game\n3: thanks.html\nfinalStep: thanks\n"
    found = read(folder, small(steps=steps, project="events: {stopServerStep: finalStep}\n"))
    assert [step.key for step in found.steps] == ["1", "2", "3"]
    assert found.events.stop_server_step == "3"


def test_a_final_step_follows_the_game(folder: Path) -> None:
    found = read(folder, small(steps="1: game\nfinalStep: thanks\n"))
    assert [step.key for step in found.steps] == ["1", "finalStep"]
    assert found.events.stop_server_step == "finalStep"


@pytest.mark.parametrize(
    ("steps", "event", "meant"),
    [
        ("1: consent\n2: game\n3: survey\nfinalStep: thanks\n", 4, "finalStep"),
        ("1: game\nfinalStep: thanks\n", 2, "finalStep"),
        ("1: consent\n2: game\n3: thanks\n", 4, "3"),
        ("1: consent\n2: game\n3: thanks\nfinalStep: thanks\n", 4, "3"),
    ],
)
def test_one_past_the_last_number_is_the_final_step_as_in_hippo(
    folder: Path, steps: str, event: int, meant: str
) -> None:
    found = read(folder, small(steps=steps, project=f"events: {{stopServerStep: {event}}}\n"))
    assert found.events.stop_server_step == found.registration()["events"]["stopServerStep"] == meant


def test_an_event_may_be_one_past_the_greatest_number_of_steps(folder: Path) -> None:
    steps = "1: game\n" + "".join(f"{k}: survey\n" for k in range(2, 501)) + "finalStep: thanks\n"
    assert read(folder, small(steps=steps, project="events: {stopServerStep: 501}\n")).events.stop_server_step == (
        "finalStep"
    )


def test_steps_are_ordered_by_number_not_by_place(folder: Path) -> None:
    steps = "finalStep: thanks\n2: survey\n1: consent\n" + "".join(f"{k}: survey\n" for k in range(3, 12))
    keys = [step.key for step in read(folder, small(steps=steps)).steps]
    assert keys == [*map(str, range(1, 12)), "finalStep"]


@pytest.mark.parametrize(
    ("steps", "events"),
    [
        ("1: consent\n2: survey\n3: game\n4: survey\n5: game\n6: survey\n7: thanks\n", ("2", "6")),
        ("1: consent\n2: game\n3: thanks\n", ("2", "3")),
        ("1: game\n2: survey\n3: game\n4: thanks\n", ("1", "4")),
        ("1: game\nfinalStep: thanks\n", ("1", "finalStep")),
    ],
)
def test_the_server_runs_from_the_step_after_the_first_answer_until_after_the_last_game(
    folder: Path, steps: str, events: tuple[str, str]
) -> None:
    found = read(folder, small(steps=steps))
    assert (found.events.start_server_step, found.events.stop_server_step) == events


AT_LINK = "every opened link starts a server, also for people who look and leave; "


@pytest.mark.parametrize(
    ("steps", "project", "expected"),
    [
        ("1: consent\n2: survey\n3: game\n4: thanks\n", "", []),
        ("1: consent\n2: game\n3: thanks\n", "", []),
        ("1: consent\n2: survey\n3: game\n4: thanks\n", "events: {startServerStep: 3}\n", []),
        ("1: consent\n2: thanks\n", "", []),
        (
            "1: consent\n2: survey\n3: game\n4: thanks\n",
            "events: {startServerStep: 1}\n",
            [f"project.events.startServerStep: {AT_LINK}with 2 only those get one who answered the first page"],
        ),
        (
            "1: consent\n2: thanks\n",
            "events: {startServerStep: 1}\n",
            [
                "project.events.startServerStep: a server starts, and no step uses it: none is game; call the step of the game "
                "that, or leave startServerStep out"
            ],
        ),
        (
            "1: game\n2: thanks\n",
            "",
            [
                f"project.steps.1: the game is the first step, so {AT_LINK}"
                "a page before it, such as a consent, keeps those out who only look"
            ],
        ),
        (
            "1: consent\n2: game\n3: thanks\n",
            "useAWS: true\nawsSetup: {cpu: 1, memory: 2}\n",
            [
                "project.steps.2: its server starts only when a participant reaches it, who then waits for a minute or "
                "more; put a page before it, or see warmServers and startServerStep"
            ],
        ),
        ("1: consent\n2: game\n3: thanks\n", "useAWS: true\nawsSetup: {cpu: 1, memory: 2}\nwarmServers: 1\n", []),
    ],
)
def test_steps_and_events_that_waste_servers_or_time_get_a_remark(
    folder: Path, steps: str, project: str, expected: list[str]
) -> None:
    found = remarks.remarks_on(folder, read(folder, small(steps=steps, project=project)))
    assert [f"{problem.where}: {problem.message}" for problem in found] == expected
    assert all(problem.remark and problem.line for problem in found)


@pytest.mark.parametrize(
    ("signed", "expected"), [("", "; "), ("signedLinks: true\n", "; signedLinks does not protect the game then; ")]
)
def test_a_front_end_without_tokens_gets_a_remark(folder: Path, signed: str, expected: str) -> None:
    keys = f"plainClients: true\nfrontEnd: https://play.example.org\nsubdomain: userId\n{signed}"
    (found,) = remarks.remarks_on(folder, read(folder, small(project=keys)))
    who = "whoever knows a participant's id can play in that participant's place"
    assert f"{found.where}: {found.message}" == f"project.plainClients: {who}{expected}see docs/security.md#identity"
    assert found.remark


@pytest.mark.parametrize(
    ("use", "expected"), [("useAWS: true\nawsSetup: {cpu: 1, memory: 2}", 1), ("", 1), ("useAWS: false", 0)]
)
def test_a_certificate_of_the_projects_own_gets_a_remark(folder: Path, use: str, expected: int) -> None:
    ssl = "ssl: {sslBucket: lab, fullchain: SSL/fullchain.pem, privkey: SSL/privkey.pem}\n"
    found = [
        f"{one.where}: {one.message}"
        for one in remarks.remarks_on(folder, read(folder, small(project=f"{ssl}{use}\n")))
    ]
    text = "project.ssl: no effect: servers get the certificate of the installation"
    assert [one for one in found if "ssl" in one] == [text] * expected


def test_an_empty_section_ssl_gets_no_remark(folder: Path) -> None:
    found = remarks.remarks_on(folder, read(folder, small(project="ssl:\n  sslBucket:\n")))
    assert [one for one in found if "ssl" in one.where] == []


# Step files


def test_consent_never_matches_consent2(folder: Path) -> None:
    (folder / "steps" / "consent.html").rename(folder / "steps" / "consent2.html")
    assert only_mistake(folder, SMALL) == "project.steps.1: there is no consent.html in steps/; did you mean consent2?"


def test_for_pages_of_groups_the_name_without_the_number_is_suggested(folder: Path) -> None:
    text = small(steps="1: brifing\n2: game\n3: thanks\n")
    assert only_mistake(folder, text) == "project.steps.1: there is no brifing.html in steps/; did you mean briefing?"


@pytest.mark.parametrize("page", ["surround", "instructions", "banks", "welcome"])
def test_names_that_differ_much_are_not_suggested(folder: Path, page: str) -> None:
    text = small(steps=f"1: {page}\n2: game\n3: thanks\n")
    assert only_mistake(folder, text) == f"project.steps.1: there is no {page}.html in steps/"


def test_only_pages_are_suggested(folder: Path) -> None:
    (folder / "steps" / "survay.png").touch()
    text = small(steps="1: survay\n2: game\n3: thanks\n")
    assert only_mistake(folder, text) == "project.steps.1: there is no survay.html in steps/; did you mean survey?"


def test_upper_and_lower_case_letters_are_different_files(folder: Path) -> None:
    text = small(steps="1: Consent\n2: game\n3: thanks\n")
    assert only_mistake(folder, text) == "project.steps.1: there is no Consent.html in steps/; did you mean consent?"


def test_a_single_group_is_a_group(folder: Path) -> None:
    (folder / "steps" / "alone-0.html").touch()
    assert read(folder, small(steps="1: alone\n")).steps[0].variants == 1


def test_a_page_whose_name_ends_in_a_number_is_a_page(folder: Path) -> None:
    (folder / "steps" / "survey-2.html").touch()
    found = read(folder, small(steps="1: survey\n2: survey-2\n3: briefing-1\n"))
    assert [(step.page, step.variants) for step in found.steps] == [("survey", 0), ("survey-2", 0), ("briefing-1", 0)]


def test_a_page_for_all_beside_pages_of_groups_is_refused(folder: Path) -> None:
    (folder / "steps" / "briefing.html").touch()
    assert only_mistake(folder, small(steps="1: briefing\n")) == (
        "project.steps.1: both briefing.html and briefing-0.html are in steps/; keep briefing.html for one page for "
        "all participants, or briefing-0.html, briefing-1.html … for groups"
    )


def test_a_gap_in_the_groups_is_named(folder: Path) -> None:
    (folder / "steps" / "briefing-1.html").unlink()
    assert only_mistake(folder, small(steps="1: briefing\n")) == (
        "project.steps.1: there is no briefing.html in steps/; if briefing-2.html is the page of a group, briefing-1.html "
        "is missing (groups are numbered 0, 1, 2 … without gaps)"
    )


def test_ten_groups_and_more_are_counted_as_numbers(folder: Path) -> None:
    for k in range(12):
        (folder / "steps" / f"many-{k}.html").touch()
    step = read(folder, small(steps="1: many\n")).steps[0]
    assert step.variants == 12
    assert step.files[10].name == "many-10.html"


def test_a_missing_folder_of_pages_gets_a_message(folder: Path) -> None:
    (folder / "steps").rename(folder / "elsewhere")
    assert mistakes(folder, SMALL) == [
        "config.yml:3: project.steps: there is no folder steps (or StepFiles) beside the file; put the pages there"
    ]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"fine\ncaf\xe9", "steps/consent.html is not UTF-8 text (line 2); save it as UTF-8"),
        (
            b"x" * (1024 * 1024 + 1),
            "steps/consent.html is larger than 1 MB; put images and videos elsewhere and link to them",
        ),
    ],
)
def test_a_page_must_be_text_of_a_limited_size(folder: Path, content: bytes, expected: str) -> None:
    (folder / "steps" / "consent.html").write_bytes(content)
    assert only_mistake(folder, SMALL) == f"project.steps.1: {expected}"


def test_a_folder_is_not_a_page(folder: Path) -> None:
    (folder / "steps" / "consent.html").unlink()
    (folder / "steps" / "consent.html").mkdir()
    assert only_mistake(folder, SMALL) == "project.steps.1: steps/consent.html is not a file"


@pytest.mark.parametrize(
    ("page", "expected"),
    [
        ("../secret", "there is no secret.html in steps/"),
        (
            "https://a.example/b",
            'must be the name of a file in the steps folder, without folders, not "https://a.example/b"',
        ),
        ("..", 'file names may hold letters (a to z), digits, spaces, dots, dashes and underscores; rename ".."'),
        ('"a\\0"', "must be the name of a file, or game; take out its tabs, line ends and invisible characters"),
        ("game.html", "a page cannot be called game.html; write game for the game step, or rename the page"),
        ("[a]", "must be the name of a file, or game, not a list"),
    ],
)
def test_a_page_is_a_plain_file_name(folder: Path, page: str, expected: str) -> None:
    assert only_mistake(folder, small(steps=f"1: {page}\n2: thanks\n")) == f"project.steps.1: {expected}"
