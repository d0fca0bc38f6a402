"""Reading a researcher's folder: what is accepted, and what each mistake is answered with."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import pytest

from hippodrome.config import Config, ConfigErrors, fargate, parse_registration, read_project, remarks
from hippodrome.config.__main__ import main

PAGES = ("consent", "briefing-0", "briefing-1", "briefing-2", "survey", "thanks")

HIPPO = """\
project:
  useAWS: true # bool, set false to ignore the AWS entries
  awsSetup:
    bucket: paddle.lab # working bucket
    region: eu-north-1
    rootDomain: play.paddle.example
    cpu: 1
    memory: 4

  events:
    startServerStep: 2 # int
    stopServerStep: 4
  id: paddle-feedback-2
  live: True
  maxRuntime: 45 # minutes
  name: Paddle with feedback
  researcher: Mio Sørensen
  ssl:
    fullchain: certs/fullchain.pem
    privkey: certs/privkey.pem
    sslBucket: paddle.lab
  steps:
    1: consent.html
    2: briefing.html
    3: game
    4: survey.html
    finalStep: thanks.html
  teamMembers:
trial:
  actionBufferLifespan: 5
  maxEpisodes: 3
  game: ALE/Pong-v5
  dataFile: trial
  s3upload: True
  actionSpace: [noop, fire, right, left]
  allowFramRateChange: yes
  frameRateStepSize: 5
  minFrameRate: 5
  maxFrameRate: 60
  startingFrameRate: 30
  ui:
    left: True
    right: True
    up: False
    start: True
    pause:
"""

SMALL = """\
project:
  id: small
  steps:
    1: consent
    2: game
    3: thanks
trial:
  game: CartPole-v1
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project folder with pages and no config.yml yet."""
    (tmp_path / "steps").mkdir()
    for page in PAGES:
        (tmp_path / "steps" / f"{page}.html").write_text(f"<h1>{page}</h1>", encoding="utf-8")
    return tmp_path


def read(folder: Path, text: str) -> Config:
    (folder / "config.yml").write_text(textwrap.dedent(text), encoding="utf-8")
    return read_project(folder)


def mistakes(folder: Path, text: str | bytes) -> list[str]:
    """The lines a researcher sees."""
    data = text if isinstance(text, bytes) else textwrap.dedent(text).encode()
    (folder / "config.yml").write_bytes(data)
    with pytest.raises(ConfigErrors) as caught:
        read_project(folder)
    lines = str(caught.value).splitlines()
    assert lines == [str(problem) for problem in caught.value.diagnostics]
    assert not any(word in line.lower() for line in lines for word in ("pydantic", "input should", "value error"))
    return lines


def small(project: str = "", trial: str = "", steps: str = "") -> str:
    """SMALL with more lines in its sections; `steps` replaces the steps."""
    text = SMALL
    if steps:
        text = re.sub(r"(?<=  steps:\n)(    .*\n)+", lambda _: textwrap.indent(steps, "    "), text)
    before, after = text.split("trial:\n")
    return before + textwrap.indent(project, "  ") + "trial:\n" + after + textwrap.indent(trial, "  ")


def one(folder: Path, text: str | bytes) -> str:
    """The one mistake of a file, without the file's name and line."""
    (line,) = mistakes(folder, text)
    return re.sub(r"^config\.yml(:\d+)?: ", "", line)


# --- what is accepted -------------------------------------------------------------------------------


def test_a_hippo_project_is_read(folder: Path) -> None:
    found = read(folder, HIPPO)
    assert found.project.id == "paddle-feedback-2"
    assert found.project.researcher == "Mio Sørensen"
    assert found.project.team_members == ()
    assert found.project.aws_setup.root_domain == "play.paddle.example"
    assert (found.project.aws_setup.cpu, found.project.aws_setup.memory) == (1, 4)
    assert found.project.max_runtime == 45
    assert found.trial.action_space == ("noop", "fire", "right", "left")
    assert found.trial.allow_frame_rate_change is True
    assert (found.trial.ui.left, found.trial.ui.up, found.trial.ui.pause, found.trial.ui.fps_up) == (
        True,
        False,
        False,
        False,
    )


def test_steps_come_in_order_with_their_files(folder: Path) -> None:
    steps = read(folder, HIPPO).steps
    assert [(step.key, step.page, step.variants) for step in steps] == [
        ("1", "consent", 0),
        ("2", "briefing", 3),
        ("3", "game", 0),
        ("4", "survey", 0),
        ("finalStep", "thanks", 0),
    ]
    assert [step.type.on_server for step in steps] == [False, False, True, False, False]
    assert steps[1].files == tuple(folder / "steps" / f"briefing-{k}.html" for k in range(3))
    assert steps[2].files == ()


def test_what_is_not_given_has_its_default(folder: Path) -> None:
    found = read(folder, SMALL).registration()
    assert found == {
        "id": "small",
        "name": "small",
        "researcher": "",
        "teamMembers": [],
        "live": True,
        "maxRuntime": 60,
        "useAWS": False,
        "awsSetup": None,
        "ssl": None,
        "events": {"startServerStep": "2", "stopServerStep": "3"},
        "steps": [
            {"key": "1", "page": "consent", "variants": 0},
            {"key": "2", "page": "game", "variants": 0},
            {"key": "3", "page": "thanks", "variants": 0},
        ],
        "cluster": "installation",
        "subdomain": "hash",
        "allowedHosts": [],
        "maxParticipants": None,
        "maxServers": None,
        "maxServerHours": None,
        "warmServers": 0,
        "signedLinks": False,
        "trial": {
            "actionBufferLifespan": 1,
            "maxEpisodes": 20,
            "betweenEpisodes": 3,
            "game": "CartPole-v1",
            "dataFile": "episode",
            "s3upload": True,
            "actionSpace": [],
            "allowFrameRateChange": False,
            "frameRateStepSize": 5,
            "minFrameRate": 1,
            "maxFrameRate": 90,
            "startingFrameRate": 30,
            "ui": {
                **dict.fromkeys(("left", "right", "up", "down", "start", "pause"), True),
                **dict.fromkeys(("stop", "reset", "trainOffline", "trainOnline", "good", "bad"), False),
                **dict.fromkeys(("fpsSet", "fpsUp", "fpsDown"), False),
            },
            "recordObservations": False,
            "lossless": False,
            "options": {},
        },
    }


def test_hippos_names_of_file_and_folder_are_accepted(folder: Path) -> None:
    (folder / "steps").rename(folder / "StepFiles")
    (folder / "config.yaml").write_text(SMALL)
    assert read_project(folder).steps[0].files == (folder / "StepFiles" / "consent.html",)


def test_a_study_without_a_game_needs_no_trial_and_no_server(folder: Path) -> None:
    found = read(folder, "project: {id: paper, steps: {1: consent, 2: survey}}")
    assert (found.events.start_server_step, found.events.stop_server_step) == (None, None)
    assert found.registration()["trial"]["game"] is None


def test_servers_that_nobody_would_ever_take_are_not_kept_warm(folder: Path) -> None:
    text = "project: {id: paper, steps: {1: consent, 2: survey}, warmServers: 2}"
    said = "project.warmServers: must be 0: no step of this study starts a server, so nobody would ever take one"
    assert one(folder, text) == said
    text = "project: {id: paper, steps: {1: consent, 2: survey}, warmServers: 2, events: {startServerStep: 1}}"
    assert read(folder, text).project.warm_servers == 2


def test_what_steps_a_study_has_is_mended_before_its_warm_servers(folder: Path) -> None:
    text = "project: {id: paper, steps: {1: consent, two: game, 3: survey}, warmServers: 2}"
    assert not any("warmServers" in line for line in mistakes(folder, text))


def test_a_project_that_is_not_live_is_a_project(folder: Path) -> None:
    assert read(folder, small(project="live: false\n")).project.live is False


def test_numbers_may_be_written_as_text(folder: Path) -> None:
    text = small(
        project='maxRuntime: "30"\nawsSetup: {cpu: 2 vCPU, memory: "8 GB"}\nevents: {startServerStep: "2"}\n',
        trial='maxEpisodes: "7"\nstartingFrameRate: 25.0\n',
    )
    found = read(folder, text)
    assert (found.project.max_runtime, found.project.aws_setup.cpu, found.project.aws_setup.memory) == (30, 2, 8)
    assert (found.trial.max_episodes, found.trial.starting_frame_rate) == (7, 25)
    assert found.events.start_server_step == "2"


@pytest.mark.parametrize(
    ("written", "meant"), [("yes", True), ("True", True), ('"no"', False), ("'False'", False), ("on", True)]
)
def test_true_and_false_as_people_write_them(folder: Path, written: str, meant: bool) -> None:
    assert read(folder, small(project=f"live: {written}\n")).project.live is meant


@pytest.mark.parametrize("written", ["007", "2024", "1e5", "0x10"])
def test_an_id_that_looks_like_a_number_stays_as_written(folder: Path, written: str) -> None:
    assert read(folder, SMALL.replace("id: small", f"id: {written}")).project.id == written


def test_a_date_as_a_name_stays_as_written(folder: Path) -> None:
    assert read(folder, small(project="name: 2031-05-01\n")).project.name == "2031-05-01"


def test_the_team_is_a_name_or_a_list(folder: Path) -> None:
    assert read(folder, small(project="teamMembers: Ada\n")).project.team_members == ("Ada",)
    assert read(folder, small(project="teamMembers: [Ada, 'Bo, the second']\n")).project.team_members == (
        "Ada",
        "Bo, the second",
    )


def test_keys_left_empty_are_keys_not_given(folder: Path) -> None:
    text = small(project='useAWS:\nname: ""\nssl:\n  sslBucket:\nevents:\n', trial="actionSpace:\nui:\nmaxEpisodes: \n")
    assert read(folder, text).registration() == read(folder, SMALL).registration()


def test_a_ui_section_shows_only_what_it_names(folder: Path) -> None:
    ui = read(folder, small(trial="ui: {good: true, bad: true}\n")).registration()["trial"]["ui"]
    assert [name for name, shown in ui.items() if shown] == ["good", "bad"]


def test_aws_keys_may_stay_incomplete_without_aws(folder: Path) -> None:
    found = read(folder, small(project="awsSetup: {bucket: lab, memory: 30}\nssl: {fullchain: a.pem}\n"))
    assert (found.registration()["awsSetup"], found.registration()["ssl"]) == (None, None)


def test_anchors_are_understood(folder: Path) -> None:
    found = read(folder, "project: {id: a, steps: {1: &page consent, 2: *page}}")
    assert [step.page for step in found.steps] == ["consent", "consent"]


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(folder: Path) -> None:
    (folder / "config.yml").write_bytes(b"\xef\xbb\xbf" + SMALL.replace("\n", "\r\n").encode())
    assert read_project(folder).project.id == "small"


def test_only_safe_yaml_is_read_and_nothing_is_run(folder: Path) -> None:
    (line,) = mistakes(folder, small(project=f"name: !!python/object/apply:os.mkdir [{folder}/made]\n"))
    assert (
        line
        == "config.yml:7: project.name: tags (! and !!) are not allowed; write the plain value, in quotes if it has a !"
    )
    assert not (folder / "made").exists()


# --- options of the agent's own ---------------------------------------------------------------------


def test_options_are_whatever_the_agent_needs(folder: Path) -> None:
    text = """\
        options:
          fingerprint: prints/a.png
          instructions: Find the minutiae; "both" hands
          minMinutiae: 12
          rates: [0.5, .25, 1.0e-3, -7]
          hints: {early: yes, late: no, never: }
          version: 007
          day: 2031-05-01
    """
    found = read(folder, small(trial=textwrap.dedent(text)))
    assert found.registration()["trial"]["options"] == {
        "fingerprint": "prints/a.png",
        "instructions": 'Find the minutiae; "both" hands',
        "minMinutiae": 12,
        "rates": [0.5, 0.25, 0.001, -7],
        "hints": {"early": True, "late": False, "never": None},
        "version": 7,
        "day": "2031-05-01",
    }


def test_options_left_empty_are_none(folder: Path) -> None:
    for text in ("options:\n", "options: {}\n"):
        assert read(folder, small(trial=text)).trial.options == {}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("[a, b]", "must be a map: indented lines such as \"difficulty: 3\" below it, not a list"),
        ("fast", "must be a map: indented lines such as \"difficulty: 3\" below it, not \"fast\""),
        (f"{{a: {'x' * 4090}}}", "must be at most 4096 characters long when written as JSON, not 4098"),
        (f"{{a: {'é' * 700}}}", "must be at most 4096 characters long when written as JSON, not 4208"),
        ("{a: [[[[[[[[1]]]]]]]]}", "must be nested no more than 8 deep"),
        ('{a: "\\ud800"}', "must be text, numbers, true or false, lists and maps; one of the values is none of these"),
        ('{"\\ud800": 1}', "must be text, numbers, true or false, lists and maps; one of the values is none of these"),
    ],
)  # fmt: skip
def test_options_that_cannot_be(folder: Path, options: str, said: str) -> None:
    assert one(folder, small(trial=f"options: {options}\n")) == f"trial.options: {said}"


def test_options_may_be_just_that_large_and_that_deep(folder: Path) -> None:
    for options in (f"{{a: {'x' * 4088}}}", "{a: [[[[[[[1]]]]]]]}"):
        assert read(folder, small(trial=f"options: {options}\n")).trial.options


# --- the last step ----------------------------------------------------------------------------------


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
def test_one_past_the_last_number_is_the_final_step_as_hippo_has_it(
    folder: Path, steps: str, event: int, meant: str
) -> None:
    found = read(folder, small(steps=steps, project=f"events: {{stopServerStep: {event}}}\n"))
    assert found.events.stop_server_step == found.registration()["events"]["stopServerStep"] == meant


def test_one_past_the_greatest_number_of_steps_is_an_event_too(folder: Path) -> None:
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
    ("steps", "project", "said"),
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
                "project.steps.2: its server starts only when somebody comes to it, so that everybody waits for a minute or "
                "more; put a page before it, or see warmServers and startServerStep"
            ],
        ),
        ("1: consent\n2: game\n3: thanks\n", "useAWS: true\nawsSetup: {cpu: 1, memory: 2}\nwarmServers: 1\n", []),
    ],
)
def test_what_the_steps_mean_for_the_servers_is_remarked(
    folder: Path, steps: str, project: str, said: list[str]
) -> None:
    found = remarks.remarks_on(folder, read(folder, small(steps=steps, project=project)))
    assert [f"{problem.where}: {problem.message}" for problem in found] == said
    assert all(problem.remark and problem.line for problem in found)


@pytest.mark.parametrize(
    ("use", "said"), [("useAWS: true\nawsSetup: {cpu: 1, memory: 2}", 1), ("", 1), ("useAWS: false", 0)]
)
def test_that_servers_get_no_other_certificate_is_remarked(folder: Path, use: str, said: int) -> None:
    ssl = "ssl: {sslBucket: lab, fullchain: SSL/fullchain.pem, privkey: SSL/privkey.pem}\n"
    found = [
        f"{one.where}: {one.message}"
        for one in remarks.remarks_on(folder, read(folder, small(project=f"{ssl}{use}\n")))
    ]
    text = (
        "project.ssl: servers get the certificate of the installation and no other; leave the section out "
        "(`register` refuses it where it names another)"
    )
    assert [one for one in found if "ssl" in one] == [text] * said


def test_an_empty_section_ssl_is_not_remarked(folder: Path) -> None:
    found = remarks.remarks_on(folder, read(folder, small(project="ssl:\n  sslBucket:\n")))
    assert [one for one in found if "ssl" in one.where] == []


# --- step files -------------------------------------------------------------------------------------


def test_consent_never_matches_consent2(folder: Path) -> None:
    (folder / "steps" / "consent.html").rename(folder / "steps" / "consent2.html")
    assert one(folder, SMALL) == "project.steps.1: there is no consent.html in steps/; did you mean consent2?"


def test_the_name_of_all_versions_is_suggested(folder: Path) -> None:
    text = small(steps="1: brifing\n2: game\n3: thanks\n")
    assert one(folder, text) == "project.steps.1: there is no brifing.html in steps/; did you mean briefing?"


@pytest.mark.parametrize("page", ["surround", "instructions", "banks", "welcome"])
def test_unlike_names_are_not_suggested(folder: Path, page: str) -> None:
    text = small(steps=f"1: {page}\n2: game\n3: thanks\n")
    assert one(folder, text) == f"project.steps.1: there is no {page}.html in steps/"


def test_only_pages_are_suggested(folder: Path) -> None:
    (folder / "steps" / "survay.png").touch()
    text = small(steps="1: survay\n2: game\n3: thanks\n")
    assert one(folder, text) == "project.steps.1: there is no survay.html in steps/; did you mean survey?"


def test_letters_of_another_size_are_another_file(folder: Path) -> None:
    text = small(steps="1: Consent\n2: game\n3: thanks\n")
    assert one(folder, text) == "project.steps.1: there is no Consent.html in steps/; did you mean consent?"


def test_a_single_group_is_a_group(folder: Path) -> None:
    (folder / "steps" / "alone-0.html").touch()
    assert read(folder, small(steps="1: alone\n")).steps[0].variants == 1


def test_a_page_whose_name_ends_in_a_number_is_a_page(folder: Path) -> None:
    (folder / "steps" / "survey-2.html").touch()
    found = read(folder, small(steps="1: survey\n2: survey-2\n3: briefing-1\n"))
    assert [(step.page, step.variants) for step in found.steps] == [("survey", 0), ("survey-2", 0), ("briefing-1", 0)]


def test_one_page_for_all_and_groups_are_a_contradiction(folder: Path) -> None:
    (folder / "steps" / "briefing.html").touch()
    assert one(folder, small(steps="1: briefing\n")) == (
        "project.steps.1: both briefing.html and briefing-0.html are in steps/; keep briefing.html for one page for "
        "everybody, or briefing-0.html, briefing-1.html … for groups"
    )


def test_a_gap_in_the_groups_is_named(folder: Path) -> None:
    (folder / "steps" / "briefing-1.html").unlink()
    assert one(folder, small(steps="1: briefing\n")) == (
        "project.steps.1: there is no briefing.html in steps/; if briefing-2.html is the page of a group, briefing-1.html "
        "is missing (groups are numbered 0, 1, 2 … without gaps)"
    )


def test_ten_groups_and_more_are_counted_as_numbers(folder: Path) -> None:
    for k in range(12):
        (folder / "steps" / f"many-{k}.html").touch()
    step = read(folder, small(steps="1: many\n")).steps[0]
    assert step.variants == 12
    assert step.files[10].name == "many-10.html"


def test_without_a_folder_of_pages(folder: Path) -> None:
    (folder / "steps").rename(folder / "elsewhere")
    assert mistakes(folder, SMALL) == [
        "config.yml:3: project.steps: there is no folder steps (or StepFiles) beside the file; put the pages there"
    ]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"fine\ncaf\xe9", "steps/consent.html is not UTF-8 text (line 2); save it as UTF-8"),
        (
            b"x" * (1024 * 1024 + 1),
            "steps/consent.html is larger than 1 MB; put images and videos elsewhere and link to them",
        ),
    ],
)
def test_a_page_must_be_text_of_a_decent_size(folder: Path, content: bytes, said: str) -> None:
    (folder / "steps" / "consent.html").write_bytes(content)
    assert one(folder, SMALL) == f"project.steps.1: {said}"


def test_a_folder_is_not_a_page(folder: Path) -> None:
    (folder / "steps" / "consent.html").unlink()
    (folder / "steps" / "consent.html").mkdir()
    assert one(folder, SMALL) == "project.steps.1: steps/consent.html is not a file"


@pytest.mark.parametrize(
    ("page", "said"),
    [
        ("../secret", 'must be the name of a file in the steps folder, without folders, not "../secret"'),
        ("steps/consent", 'must be the name of a file in the steps folder, without folders, not "steps/consent"'),
        ("a\\b", 'must be the name of a file in the steps folder, without folders, not "a\\b"'),
        ("..", 'file names may hold letters (a to z), digits, spaces, dots, dashes and underscores; rename ".."'),
        ('"a\\0"', "must be the name of a file, or game; without tabs, line ends and invisible characters"),
        ("game.html", "a page cannot be called game.html; write game for the game step, or rename the page"),
        ("", "has no page; write the name of its file, or game"),
        ("[a]", "must be the name of a file, or game, not a list"),
    ],
)
def test_a_page_is_a_plain_file_name(folder: Path, page: str, said: str) -> None:
    assert one(folder, small(steps=f"1: {page}\n2: thanks\n")) == f"project.steps.1: {said}"


# --- the file itself --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "config.yml: the file is empty; it needs the sections project and trial"),
        (b"# nothing\n", "config.yml: the file is empty; it needs the sections project and trial"),
        (b"- a\n- b\n", 'config.yml:1: the file must be a map that begins with "project:"'),
        (b"hello", 'config.yml:1: the file must be a map that begins with "project:"'),
        (b"project:\n\tid: a\n", "config.yml:2: the line is indented with a tab; YAML wants spaces"),
        (b"project:\n  id: caf\xe9\n", "config.yml:2: the file is not UTF-8 text from here on; save it as UTF-8"),
        ("project:\n".encode("utf-16"), "config.yml:1: the file is UTF-16 or UTF-32 text; save it as UTF-8"),
        (b"a: b\x07\n", "config.yml:1: an invisible control character that YAML does not allow; delete it"),
        (b"x" * 300_000, "config.yml: the file is larger than 256 KB, which no project needs"),
        (
            b"a:\n  b: 1\n c: 2\n",
            "config.yml:3: the indentation does not match the lines above; a section's keys start in one column",
        ),
        (b"a: b: c\n", "config.yml:1: an unexpected colon; check the indentation, put text with a colon in quotes"),
        (b"project:\n  id:a\n  live: true\n", 'config.yml:2: the space after the colon is missing; write "id: a"'),
        (b"steps:\n  1:consent\n  2: game\n", 'config.yml:2: the space after the colon is missing; write "1: consent"'),
        (b"a: " + b"[" * 5000, "config.yml: the sections are nested too deeply"),
        (b"a: " + b"{b: " * 30 + b"1" + b"}" * 30, "config.yml:1: the sections are nested too deeply"),
    ],
)
def test_a_file_that_cannot_be_read_is_answered_with_a_sentence(folder: Path, data: bytes, said: str) -> None:
    assert mistakes(folder, data) == [said]


@pytest.mark.parametrize(
    ("text", "line", "quoted"),
    [
        ('a:\n  b: "open\n  c: d\n', 2, '"b: "open"'),
        ("a: [1, 2\nb: 3\n", 2, '"b: 3"'),
        ("a: *no\n", 1, '"a: *no"'),
        ("a: @lab\n", 1, '"a: @lab"'),
        ("a: 1\n---\nb: 2\n", 2, '"---"'),
        ("a: 1\nb: 'it's'\n", 2, "\"b: 'it's'\""),
        ("a: 1\nlive\nb: 2\n", 2, '"live"'),
        ('a: "\\q"\n', 1, '"a: "\\q""'),
    ],
)
def test_other_syntax_errors_are_told_as_yaml_tells_them(folder: Path, text: str, line: int, quoted: str) -> None:
    """With the line, its text and what to look at."""
    (said,) = mistakes(folder, text)
    assert said.startswith(f"config.yml:{line}: YAML cannot read {quoted}, column ")
    assert said.endswith("; check quotes, brackets and indentation")


def test_a_bomb_of_anchors_does_not_go_off(folder: Path) -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]" for k in range(1, 12)]
    said = "config.yml: the file holds too many values; do not repeat large parts with aliases (*name)"
    assert mistakes(folder, "\n".join(lines)) == [said]


def test_an_anchor_within_itself_ends(folder: Path) -> None:
    assert mistakes(folder, "a: &a [*a]") == ["config.yml:1: the sections are nested too deeply"]


def test_no_folder(folder: Path) -> None:
    for place, said in (
        (folder / "nowhere", "there is no such folder"),
        (folder / "steps" / "consent.html", "this is a file; name the folder it is in"),
    ):
        with pytest.raises(ConfigErrors) as caught:
            read_project(place)
        assert str(caught.value) == f"{place}: {said}"


def test_no_file_and_two_files(folder: Path) -> None:
    with pytest.raises(ConfigErrors) as caught:
        read_project(folder)
    assert str(caught.value) == f"config.yml: there is no such file in {folder}"
    (folder / "config.yaml").write_text(SMALL)
    assert mistakes(folder, SMALL) == ["config.yml: there is a config.yaml too; keep only one of them"]


def test_a_key_given_twice(folder: Path) -> None:
    assert mistakes(folder, small(project="live: true\nid: other\nlive: false\n")) == [
        "config.yml:8: project.id: given twice (first on line 2); keep one",
        "config.yml:9: project.live: given twice (first on line 7); keep one",
    ]
    text = small(steps='1: consent\n"1": survey\n2: thanks\n')
    assert mistakes(folder, text) == ["config.yml:5: project.steps.1: given twice (first on line 4); keep one"]


def test_merge_keys_and_odd_keys(folder: Path) -> None:
    assert one(folder, small(project="<<: {live: true}\n")) == "project: << is not allowed; write the keys out"
    said = "project: a key must be a plain word or number, not a list or a map"
    assert one(folder, small(project="? [a, b]\n: c\n")) == said


# --- keys -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("project", "trial", "said"),
    [
        ("maxRuntme: 5", "", "project.maxRuntme: unknown key; did you mean maxRuntime?"),
        ("max_runtime: 5", "", "project.max_runtime: unknown key; did you mean maxRuntime?"),
        ("maxEpisodes: 5", "", "project.maxEpisodes: unknown key; it belongs under trial (check the indentation)"),
        (
            "rootDomain: a.b",
            "",
            "project.rootDomain: unknown key; it belongs under project.awsSetup (check the indentation)",
        ),
        (
            "trial: {game: x}",
            "",
            "project.trial: unknown key; it belongs at the top of the file, not indented (check the indentation)",
        ),
        (
            "finalStep: thanks",
            "",
            "project.finalStep: unknown key; it belongs under project.steps (check the indentation)",
        ),
        ("epsiodes: 3", "", "project.epsiodes: unknown key; docs/config.md lists all keys"),
        ("max_episodes: 3", "", "project.max_episodes: unknown key; did you mean trial.maxEpisodes?"),
        (
            "events: {begin: 1}",
            "",
            "project.events.begin: unknown key; the keys here are startServerStep, stopServerStep",
        ),
        (
            "",
            "minMinutiae: 12",
            "trial.minMinutiae: unknown key; docs/config.md lists all keys; a key of your agent's own goes under trial.options",
        ),
        (
            "",
            "maxEpisods: 12",
            "trial.maxEpisods: unknown key; did you mean maxEpisodes? If not, a key of your agent's own goes under trial.options",
        ),
        ("", "live: true", "trial.live: unknown key; it belongs under project (check the indentation)"),
        ("", "trainOnline: true", "trial.trainOnline: unknown key; it belongs under trial.ui (check the indentation)"),
        ("", "ui: {fps: true}", "trial.ui.fps: unknown key; did you mean fpsUp?"),
        (
            "ssl: hello",
            "",
            'project.ssl: must be a section: indented lines such as "fullchain: …" below it, not "hello"',
        ),
        (
            "awsSetup: [a]",
            "",
            'project.awsSetup: must be a section: indented lines such as "bucket: …" below it, not a list',
        ),
        (
            "",
            "allowFrameRateChange: no\nallowFramRateChange: no",
            "trial.allowFramRateChange: allowFrameRateChange is given too; keep that one",
        ),
    ],
)
def test_a_key_in_the_wrong_place_or_with_the_wrong_name(folder: Path, project: str, trial: str, said: str) -> None:
    assert one(folder, small(project=project + "\n" if project else "", trial=trial + "\n" if trial else "")) == said


def test_a_trial_indented_under_the_project_is_one_mistake(folder: Path) -> None:
    text = SMALL.replace("trial:", "  trial:").replace("  game:", "    game:")
    assert mistakes(folder, text) == [
        "config.yml:7: project.trial: unknown key; it belongs at the top of the file, not indented (check the indentation)"
    ]


def test_sections_that_are_missing(folder: Path) -> None:
    assert mistakes(folder, "trial: {}") == ["config.yml:1: the section project is missing"]
    assert mistakes(folder, "projct: {id: a}") == ["config.yml:1: projct: unknown key; did you mean project?"]
    assert mistakes(folder, "project:\n  name: x\n") == [
        "config.yml:1: project.id: missing; give the project an id of letters, digits and dashes",
        'config.yml:1: project.steps: missing; list the pages in order, such as "1: consent"',
    ]
    text = SMALL.replace("  game: CartPole-v1\n", "  maxEpisodes: 2\n")
    assert mistakes(folder, text) == [
        "config.yml:7: trial.game: missing; a project with a game step needs the name of its environment"
    ]


@pytest.mark.parametrize(
    ("project", "said"),
    [
        ("live: perhaps", 'live: must be true or false, not "perhaps"'),
        ("live: 1", "live: must be true or false, not 1"),
        ("maxParticipants: 0", "maxParticipants: must be a whole number from 1 to 100000, not 0"),
        ("maxServers: all", 'maxServers: must be a whole number from 1 to 10000, not "all"'),
        ("maxServerHours: 1.5", "maxServerHours: must be a whole number from 1 to 1000000, not 1.5"),
        (
            "maxServerHours: 1\nmaxRuntime: 90",
            "maxServerHours: must be at least 2, since one server may run 90 minutes",
        ),
        ("warmServers: -1", "warmServers: must be a whole number from 0 to 100, not -1"),
        ("warmServers: 101", "warmServers: must be a whole number from 0 to 100, not 101"),
        (
            "warmServers: 2\nsubdomain: userId",
            "warmServers: a warm server's name is made before anybody comes: use subdomain: hash, or warmServers: 0",
        ),
        (
            "warmServers: 3\nmaxServers: 2",
            "warmServers: must be at most maxServers, which is 2: a warm server is one of them",
        ),
        ("signedLinks: perhaps", 'signedLinks: must be true or false, not "perhaps"'),
        ("maxRuntime: 0", "maxRuntime: must be a whole number from 1 to 1440, not 0"),
        ("maxRuntime: 1:30", 'maxRuntime: must be a whole number from 1 to 1440, not "1:30"'),
        ("maxRuntime: .inf", 'maxRuntime: must be a whole number from 1 to 1440, not ".inf"'),
        ("maxRuntime: 2.5", "maxRuntime: must be a whole number from 1 to 1440, not 2.5"),
        ("maxRuntime: true", "maxRuntime: must be a whole number from 1 to 1440, not true"),
        ("maxRuntime: [1]", "maxRuntime: must be a whole number from 1 to 1440, not a list"),
        (f"maxRuntime: {'9' * 5000}", f'maxRuntime: must be a whole number from 1 to 1440, not "{"9" * 59}…"'),
        ("name: {a: b}", "name: must be a name, not a map"),
        ("researcher: on", 'researcher: must be text; YAML reads on as true or false, so write "on" in quotes'),
        (f"name: {'n' * 501}", "name: must be at most 500 characters long, not 501"),
        ('name: "\\ud800"', "name: must be a name; without tabs, line ends and invisible characters"),
        ("teamMembers: {a: b}", "teamMembers: must be a list: a line with a dash for each person, not a map"),
        ("teamMembers: [Ada, [Bo]]", "teamMembers item 2: must be text, not a list"),
        ("cluster: shared", 'cluster: must be installation or participant, not "shared"'),
        ("subdomain: user", 'subdomain: must be hash or userId, not "user"'),
        ("allowedHosts: https://a.org", 'allowedHosts: must be a list: a line with a dash for each https:// address, not "https://a.org"'),
        ("allowedHosts: [http://a.org]", 'allowedHosts item 1: must be an address such as https://example.org, without path and without *, not "http://a.org"'),
        ("allowedHosts: [a.org]", "allowedHosts item 1: must begin with https://; write https://a.org"),
        ("allowedHosts: [https://a.org/x]", "allowedHosts item 1: must be the host only, without a path; write https://a.org"),
        ("allowedHosts: [https://a.org; script-src *]", 'allowedHosts item 1: must be an address such as https://example.org, without path and without *, not "https://a.org; script-src *"'),
        ("awsSetup: {bucket: s3://lab}", 'awsSetup.bucket: must be the bucket\'s name alone, without s3:// or folders, not "s3://lab"'),
        ("awsSetup: {bucket: Lab}", 'awsSetup.bucket: bucket names have small letters only; is it "lab"?'),
        ("awsSetup: {region: eu-west-1b}", "awsSetup.region: eu-west-1b is an availability zone; the region is eu-west-1"),
        ("awsSetup: {region: Ireland}", 'awsSetup.region: must be an AWS region such as ca-central-1, not "Ireland"'),
        ("awsSetup: {rootDomain: 'https://A.lab.org/x'}", "awsSetup.rootDomain: must be the domain name only, without https:// or a path; write a.lab.org"),
        ("awsSetup: {rootDomain: localhost}", 'awsSetup.rootDomain: must be a domain name such as example.org, not "localhost"'),
        ("awsSetup: {rootDomain: 10.0.0.1}", 'awsSetup.rootDomain: must be a domain name such as example.org, not "10.0.0.1"'),
        ("awsSetup: {cpu: 3}", "awsSetup.cpu: must be a number of vCPUs: 0.25, 0.5, 1, 2, 4, 8 or 16, not 3"),
        ("awsSetup: {cpu: 1024}", "awsSetup.cpu: must be a number of vCPUs: 0.25, 0.5, 1, 2, 4, 8 or 16, not 1024 (1024 CPU units are 1 vCPU)"),
        ("awsSetup: {memory: 8192}", "awsSetup.memory: must be a number of GB from 0.5 to 120, not 8192 (8192 MB are 8 GB)"),
        ("ssl: {fullchain: s3://lab/a.pem}", 'ssl.fullchain: must be the path within the bucket, such as SSL/fullchain.pem, not "s3://lab/a.pem"'),
        ("events: {startServerStep: first}", 'events.startServerStep: must be the number of a step or finalStep, not "first"'),
    ],
)  # fmt: skip
def test_a_value_of_the_project_that_cannot_be(folder: Path, project: str, said: str) -> None:
    assert one(folder, small(project=project + "\n")) == f"project.{said}"


@pytest.mark.parametrize(
    ("trial", "said"),
    [
        ("maxEpisodes: many", 'maxEpisodes: must be a whole number from 1 to 1000000, not "many"'),
        ("maxEpisodes: 0", "maxEpisodes: must be a whole number from 1 to 1000000, not 0"),
        ("actionBufferLifespan: -1", "actionBufferLifespan: must be a whole number from 1 to 10000, not -1"),
        ("dataFile: episodes", 'dataFile: must be episode or trial, not "episodes"'),
        ("s3upload: sure", 's3upload: must be true or false, not "sure"'),
        ("recordObservations: 2", "recordObservations: must be true or false, not 2"),
        ("lossless: always", 'lossless: must be true or false, not "always"'),
        ("frameRateStepSize: 0", "frameRateStepSize: must be a whole number from 1 to 240, not 0"),
        ("maxFrameRate: 500", "maxFrameRate: must be a whole number from 1 to 240, not 500"),
        ("actionSpace: up", 'actionSpace: must be a list: a line with a dash for each action, not "up"'),
        ("actionSpace: [up, off]", 'actionSpace item 2: must be the name of an action; YAML reads off as true or false, so write "off" in quotes'),
        ("actionSpace: [up, down, up]", 'actionSpace item 3: "up" is item 1 already; names must differ'),
        ("ui: [left]", 'ui: must be a section: indented lines such as "bad: …" below it, not a list'),
        ("ui: {left: maybe}", 'ui.left: must be true or false, not "maybe"'),
        ("allowFramRateChange: 3", "allowFrameRateChange: must be true or false, not 3"),
        ("minFrameRate: 40\nmaxFrameRate: 20", "minFrameRate: must be at most maxFrameRate, which is 20, not 40"),
        ("startingFrameRate: 100", "startingFrameRate: must be at most maxFrameRate, which is 90 by default, not 100; set maxFrameRate too"),
        ("startingFrameRate: 5\nminFrameRate: 10", "startingFrameRate: must be at least minFrameRate, which is 10, not 5"),
        ("maxFrameRate: 20", "maxFrameRate: must be at least startingFrameRate, which is 30 by default, not 20; set startingFrameRate too"),
        ("minFrameRate: 40", "minFrameRate: must be at most startingFrameRate, which is 30 by default, not 40; set startingFrameRate too"),
    ],
)  # fmt: skip
def test_a_value_of_the_trial_that_cannot_be(folder: Path, trial: str, said: str) -> None:
    assert one(folder, small(trial=trial + "\n")) == f"trial.{said}"


@pytest.mark.parametrize("written", ["my study", "my_study", "my/study"])
def test_an_id_has_letters_digits_and_dashes(folder: Path, written: str) -> None:
    said = f'project.id: may hold only letters, digits and dashes, not "{written}"; write for example "my-study"'
    assert one(folder, SMALL.replace("id: small", f"id: {written}")) == said


def test_the_folder_of_the_certificate_is_no_project(folder: Path) -> None:
    """Servers may write nothing below SSL/: a study of this name would keep no answer of a game."""
    said = "project.id: must not be SSL: that is the folder of the servers' certificate in the bucket"
    assert one(folder, SMALL.replace("id: small", "id: SSL")) == said
    assert read(folder, SMALL.replace("id: small", "id: SSL-study")).project.id == "SSL-study"
    with pytest.raises(ConfigErrors, match="must not be SSL"):
        parse_registration({"id": "SSL", "steps": [{"key": "1", "page": "hello"}, {"key": "2", "page": "bye"}]})


def test_an_id_has_at_most_64_characters(folder: Path) -> None:
    assert read(folder, SMALL.replace("id: small", f"id: {'a' * 64}")).project.id == "a" * 64
    said = "project.id: must be at most 64 characters long, not 65"
    assert one(folder, SMALL.replace("id: small", f"id: {'a' * 65}")) == said


@pytest.mark.parametrize(
    "name", ["ab", "a" * 64, "-lab", "lab-", "a..b", "10.0.0.1", "xn--lab", "lab-s3alias", "la_b", "sthree-lab"]
)
def test_buckets_follow_the_rules_of_s3(folder: Path, name: str) -> None:
    assert "must be the name of an S3 bucket" in one(folder, small(project=f"awsSetup: {{bucket: {name}}}\n"))


# --- values against each other ----------------------------------------------------------------------


def test_aws_needs_its_keys(folder: Path) -> None:
    assert mistakes(folder, small(project="useAWS: true\nawsSetup:\n  bucket:\n  region: eu-west-1\n")) == [
        "config.yml:8: project.awsSetup.cpu: missing; useAWS is true, so give the vCPUs of a server, such as 1",
        "config.yml:8: project.awsSetup.memory: missing; useAWS is true, so give the memory of a server in GB, such as 4",
    ]


def test_where_on_aws_may_be_left_to_the_installation(folder: Path) -> None:
    found = read(folder, small(project="useAWS: true\nawsSetup: {cpu: 1, memory: 4, region: eu-west-1}\n"))
    here = {"bucket": None, "region": "eu-west-1", "rootDomain": None, "cpu": 1, "memory": 4}
    assert found.registration()["awsSetup"] == here
    assert parse_registration(found.registration())["awsSetup"] == here


def aws(cpu: object, memory: object) -> str:
    return small(
        project=f"useAWS: true\nawsSetup: {{bucket: lab, region: eu-west-1, rootDomain: a.org, cpu: {cpu}, memory: {memory}}}\n"
    )


@pytest.mark.parametrize(
    ("cpu", "memory"), [(c, m) for c, sizes in fargate.SIZES.items() for m in (sizes[0], sizes[-1])]
)
def test_sizes_that_fargate_has(folder: Path, cpu: float, memory: float) -> None:
    found = read(folder, aws(cpu, memory)).registration()["awsSetup"]
    assert (found["cpu"], found["memory"]) == (cpu, memory)


@pytest.mark.parametrize(
    ("cpu", "memory", "said"),
    [
        (0.25, 4, "4 GB do not go with cpu 0.25; choose 0.5, 1 or 2"),
        (".5", "0.5", "0.5 GB do not go with cpu 0.5; choose 1 to 4"),
        (1, 10, "10 GB do not go with cpu 1; choose 2 to 8"),
        (2, 4.5, "4.5 GB do not go with cpu 2; choose 4 to 16"),
        (4, 31, "31 GB do not go with cpu 4; choose 8 to 30"),
        (8, 18, "18 GB do not go with cpu 8; choose 16 to 60 in steps of 4"),
        (16, 24, "24 GB do not go with cpu 16; choose 32 to 120 in steps of 8"),
    ],
)
def test_sizes_that_fargate_does_not_have(folder: Path, cpu: object, memory: object, said: str) -> None:
    assert one(folder, aws(cpu, memory)) == f"project.awsSetup.memory: {said}"


def test_a_certificate_is_given_whole_or_not_at_all(folder: Path) -> None:
    text = aws(1, 2).replace("trial:", "  ssl: {fullchain: a.pem, privkey: b.pem}\ntrial:")
    assert one(folder, text) == "project.ssl.sslBucket: missing; give sslBucket, fullchain and privkey, or none of them"


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ("1: consent\n3: thanks\n", "3: step 2 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ("1: consent\n5: thanks\n", "5: steps 2 to 4 are missing before it; number the steps 1, 2, 3 … without gaps"),
        ("2: consent\n", "2: step 1 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ("finalStep: thanks\n", "finalStep: step 1 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ("0: consent\n1: thanks\n", "0: a step's key is 1, 2, 3 … or finalStep"),
        ("1: consent\n02: thanks\n", "02: a step's key is 1, 2, 3 … or finalStep"),
        ("1: consent\nfinalstep: thanks\n", "finalstep: write finalStep"),
        ("1: consent\n501: thanks\n", "501: a project has at most 500 steps"),
        ("1: consent\n2: game\n", "2: the game cannot be the last step; add a page after it, which stops the server"),
        ("1: consent\nfinalStep: game\n", "finalStep: the game cannot be the last step; add a page after it, which stops the server"),
    ],
)  # fmt: skip
def test_steps_are_numbered_without_gaps_and_end_with_a_page(folder: Path, steps: str, said: str) -> None:
    assert one(folder, small(steps=steps)) == f"project.steps.{said}"


def test_steps_are_not_a_dashed_list(folder: Path) -> None:
    text = "project:\n  id: a\n  steps:\n    - consent\n    - thanks\n"
    said = 'project.steps: must be a section: indented lines such as "1: consent" below it, not a list'
    assert one(folder, text) == said


@pytest.mark.parametrize(
    ("events", "said"),
    [
        ("startServerStep: 9", "startServerStep: there is no step 9; the steps are 1 to 4 and finalStep"),
        ("stopServerStep: 6", "stopServerStep: there is no step 6; the steps are 1 to 4 and finalStep"),
        ("startServerStep: 5", "startServerStep: finalStep comes after the game, step 3, which needs the server; 2 is the usual choice"),
        ("startServerStep: 4", "startServerStep: step 4 comes after the game, step 3, which needs the server; 2 is the usual choice"),
        ("stopServerStep: 3", "stopServerStep: step 3 does not come after the game, step 3, which needs the server; use 4 or later"),
        ("stopServerStep: 1", "stopServerStep: step 1 does not come after the game, step 3, which needs the server; use 4 or later"),
    ],
)  # fmt: skip
def test_the_server_runs_around_the_game(folder: Path, events: str, said: str) -> None:
    steps = "1: consent\n2: survey\n3: game\n4: survey\nfinalStep: thanks\n"
    assert one(folder, small(steps=steps, project=f"events: {{{events}}}\n")) == f"project.events.{said}"


def test_both_events_can_be_wrong(folder: Path) -> None:
    text = small(
        steps="1: consent\n2: game\n3: thanks\n", project="events:\n  startServerStep: 3\n  stopServerStep: 1\n"
    )
    said = ["which needs the server; 2 is the usual choice", "which needs the server; use 3 or later"]
    assert [line[-len(end) :] for line, end in zip(mistakes(folder, text), said, strict=True)] == said


def test_a_server_does_not_stop_before_it_starts(folder: Path) -> None:
    text = small(steps="1: consent\n2: thanks\n", project="events: {startServerStep: 2, stopServerStep: 1}\n")
    assert one(folder, text) == "project.events.stopServerStep: step 1 comes before startServerStep, step 2"


# --- all at once, with their lines ------------------------------------------------------------------


def test_all_mistakes_come_at_once_in_line_order(folder: Path) -> None:
    text = """\
        project:
          useAWS: true
          awsSetup:
            bucket: paddle.lab
            region: europe
            rootDomain: play.paddle.example
            cpu: 2
            memory: 40
          id: paddle_study
          maxRuntme: 30
          steps:
            1: consnt
            2: game
            4: thanks
          events:
            stopServerStep: 9
          actionSpace: [up]
        trial:
          maxEpisodes: many
          minFrameRate: 50
          actionSpace:
            - up
            - down
            - no
    """
    assert mistakes(folder, text) == [
        'config.yml:5: project.awsSetup.region: must be an AWS region such as ca-central-1, not "europe"',
        "config.yml:8: project.awsSetup.memory: 40 GB do not go with cpu 2; choose 4 to 16",
        'config.yml:9: project.id: may hold only letters, digits and dashes, not "paddle_study"; write for example "paddle-study"',
        "config.yml:10: project.maxRuntme: unknown key; did you mean maxRuntime?",
        "config.yml:12: project.steps.1: there is no consnt.html in steps/; did you mean consent?",
        "config.yml:14: project.steps.4: step 3 is missing before it; number the steps 1, 2, 3 … without gaps",
        "config.yml:16: project.events.stopServerStep: there is no step 9; the steps are 1 to 4",
        "config.yml:17: project.actionSpace: unknown key; it belongs under trial (check the indentation)",
        "config.yml:18: trial.game: missing; a project with a game step needs the name of its environment",
        'config.yml:19: trial.maxEpisodes: must be a whole number from 1 to 1000000, not "many"',
        "config.yml:20: trial.minFrameRate: must be at most startingFrameRate, which is 30 by default, not 50; "
        "set startingFrameRate too",
        'config.yml:24: trial.actionSpace item 3: must be the name of an action; YAML reads no as true or false, so write "no" in quotes',
    ]  # fmt: skip


def test_a_problem_says_where_it_is(folder: Path) -> None:
    (folder / "config.yml").write_text(small(trial="maxEpisodes: many\n"))
    with pytest.raises(ConfigErrors) as caught:
        read_project(folder)
    (problem,) = caught.value.diagnostics
    assert (problem.file, problem.line, problem.where) == ("config.yml", 9, "trial.maxEpisodes")
    assert problem.message == 'must be a whole number from 1 to 1000000, not "many"'
    assert str(problem) == f"config.yml:9: trial.maxEpisodes: {problem.message}"


def test_a_message_never_carries_invisible_or_endless_text(folder: Path) -> None:
    line = one(folder, small(project=f'live: "\\e[31m\\u202e{"x" * 500}"\n'))
    assert line.isprintable()
    assert len(line) < 120


# --- the command line -------------------------------------------------------------------------------


def test_check_says_that_all_is_well(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "config.yml").write_text(HIPPO, encoding="utf-8")
    assert main(["check", str(folder)]) == 0
    assert capsys.readouterr().out == (
        "config.yml is fine: 5 steps, step 3 is the game (ALE/Pong-v5), briefing in 3 groups, "
        "a server from step 2 to step 4, at most 45 minutes\n"
    )


def test_check_says_how_many_servers_wait(folder: Path) -> None:
    summary = read(folder, small(project="warmServers: 4\n")).summary()
    assert summary.endswith("a server from step 2 to step 3, at most 60 minutes, 4 kept warm")


def test_check_prints_mistakes_and_fails(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "config.yml").write_text(small(project="live: perhaps\nmaxRuntime: 0\n"))
    monkeypatch.chdir(folder)
    assert main(["check"]) == 1
    assert capsys.readouterr().out == (
        'config.yml:7: project.live: must be true or false, not "perhaps"\n'
        "config.yml:8: project.maxRuntime: must be a whole number from 1 to 1440, not 0\n"
    )
