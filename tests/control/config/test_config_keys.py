"""The keys of config.yml and their values: the message for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, fargate, parse_registration
from tests.control.config.folder import SMALL, mistakes, only_mistake, read, small

# Keys


@pytest.mark.parametrize(
    ("project", "trial", "expected"),
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
        ("max_episodes: 3", "", "project.max_episodes: unknown key; did you mean trial.maxEpisodes?"),
        (
            "",
            "maxEpisods: 12",
            "trial.maxEpisods: unknown key; did you mean maxEpisodes? If not, a key of your agent's own goes under trial.options",
        ),
        ("", "live: true", "trial.live: unknown key; it belongs under project (check the indentation)"),
        ("", "trainOnline: true", "trial.trainOnline: unknown key; it belongs under trial.ui (check the indentation)"),
        ("", "ui: {fpsDwn: true}", "trial.ui.fpsDwn: unknown key; did you mean fpsDown?"),
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
def test_a_key_in_the_wrong_place_or_with_a_wrong_name_gets_a_message(
    folder: Path, project: str, trial: str, expected: str
) -> None:
    assert (
        only_mistake(folder, small(project=project + "\n" if project else "", trial=trial + "\n" if trial else ""))
        == expected
    )


def test_a_trial_indented_under_the_project_is_one_mistake(folder: Path) -> None:
    text = SMALL.replace("trial:", "  trial:").replace("  game:", "    game:")
    assert mistakes(folder, text) == [
        "config.yml:7: project.trial: unknown key; it belongs at the top of the file, not indented (check the indentation)"
    ]


def test_missing_sections_get_a_message(folder: Path) -> None:
    assert mistakes(folder, "trial: {}") == ["config.yml:1: the section project is missing"]
    assert mistakes(folder, "projct: {id: a}") == ["config.yml:1: projct: unknown key; did you mean project?"]
    assert mistakes(folder, "project:\n  name: x\n") == [
        "config.yml:1: project.id: missing; give the project an id of letters, digits, dashes and underscores",
        'config.yml:1: project.steps: missing; list the pages in order, such as "1: consent"',
    ]
    text = SMALL.replace("  game: CartPole-v1\n", "  maxEpisodes: 2\n")
    assert mistakes(folder, text) == [
        "config.yml:7: trial.game: missing; a project with a game step needs the name of its environment"
    ]


@pytest.mark.parametrize(
    ("project", "expected"),
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
            "warmServers: a warm server gets its name before a participant takes it: use subdomain: hash, or warmServers: 0",
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
        ("teamMembers: {a: b}", "teamMembers: must be a list: a line with a dash for each person, not a map"),
        ("teamMembers: [Ada, [Bo]]", "teamMembers item 2: must be text, not a list"),
        ("cluster: shared", 'cluster: must be installation or participant, not "shared"'),
        ("subdomain: user", 'subdomain: must be hash or userId, not "user"'),
        ("plainClients: perhaps", 'plainClients: must be true or false, not "perhaps"'),
        (
            "plainClients: true\nsubdomain: userId",
            "frontEnd: missing; plainClients is true, so say where the front end is, such as https://play.example.org",
        ),
        (
            "plainClients: true\nfrontEnd: https://play.example.org",
            "plainClients: HIPPO's front end finds servers by the participant's id: use subdomain: userId, or false",
        ),
        ("frontEnd: http://a.org", 'frontEnd item 1: must be an address such as https://example.org, without path and without *, not "http://a.org"'),
        ("frontEnd: https://a.org/play", "frontEnd item 1: must be the host only, without a path; write https://a.org"),
        ("frontEnd: https://*.a.org", 'frontEnd item 1: must be an address such as https://example.org, without path and without *, not "https://*.a.org"'),
        ("frontEnd: http://localhost.a.org", 'frontEnd item 1: must be an address such as https://example.org, without path and without *, not "http://localhost.a.org"'),
        ("recordHeaders: user-agent", 'recordHeaders: must be a list: a line with a dash for each name of a header, not "user-agent"'),
        ("recordHeaders: [User Agent]", 'recordHeaders item 1: must be the name of a header, such as user-agent, not "User Agent"'),
        ("recordHeaders: [Cookie]", "recordHeaders item 1: cookie may hold secrets of the browser, and is never kept"),
        ("allowedHosts: https://a.org", 'allowedHosts: must be a list: a line with a dash for each https:// address, not "https://a.org"'),
        ("allowedHosts: [http://a.org]", 'allowedHosts item 1: must be an address such as https://example.org, without path and without *, not "http://a.org"'),
        ("allowedHosts: [a.org]", "allowedHosts item 1: must begin with https://; write https://a.org"),
        ("allowedHosts: [https://a.org/x]", "allowedHosts item 1: must be the host only, without a path; write https://a.org"),
        ("allowedHosts: [https://a.org; script-src *]", 'allowedHosts item 1: must be an address such as https://example.org, without path and without *, not "https://a.org; script-src *"'),
        ("awsSetup: {region: eu-west-1b}", "awsSetup.region: eu-west-1b is an availability zone; the region is eu-west-1"),
        ("awsSetup: {region: Ireland}", 'awsSetup.region: must be an AWS region such as ca-central-1, not "Ireland"'),
        ("awsSetup: {rootDomain: 'https://A.lab.org/x'}", "awsSetup.rootDomain: must be the domain name only, without https:// or a path; write a.lab.org"),
        ("awsSetup: {rootDomain: localhost}", 'awsSetup.rootDomain: must be a domain name such as example.org, not "localhost"'),
        ("awsSetup: {rootDomain: 10.0.0.1}", 'awsSetup.rootDomain: must be a domain name such as example.org, not "10.0.0.1"'),
        ("awsSetup: {cpu: 3}", "awsSetup.cpu: must be a number of vCPUs: 0.25, 0.5, 1, 2, 4, 8 or 16, not 3"),
        ("awsSetup: {cpu: 1024}", "awsSetup.cpu: must be a number of vCPUs: 0.25, 0.5, 1, 2, 4, 8 or 16, not 1024 (1024 CPU units are 1 vCPU)"),
        ("awsSetup: {memory: 8192}", "awsSetup.memory: must be a number of GB from 0.5 to 120, not 8192 (8192 MB are 8 GB)"),
        ("events: {startServerStep: the game}", 'events.startServerStep: must be the number of a step or finalStep, not "the game"'),
    ],
)  # fmt: skip
def test_a_wrong_value_under_project_gets_a_message(folder: Path, project: str, expected: str) -> None:
    assert only_mistake(folder, small(project=project + "\n")) == f"project.{expected}"


@pytest.mark.parametrize(
    ("trial", "expected"),
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
        ("ui: [[left]]", 'ui: must be a section: indented lines such as "bad: …" below it, not a list'),
        ("ui: {left: maybe}", 'ui.left: must be true or false, not "maybe"'),
        ("scene: yes", "scene: must be a section: indented lines such as \"width: 600\" below it, not yes"),
        ("scene: {width: 0}", "scene.width: must be a whole number from 1 to 4096, not 0"),
        ("scene: {background: white}", 'scene.background: must be a color such as "#ffffff", in quotes, not "white"'),
        ("scene: {coordinates: world}", 'scene.coordinates: must be relative or pixels, not "world"'),
        ("scene: {assets: ../../etc}", 'scene.assets: must be a folder of the project, such as assets, not "../../etc"'),
        ("scene: {assets: /etc}", 'scene.assets: must be a folder of the project, such as assets, not "/etc"'),
        ("scene: {widht: 3}", "scene.widht: unknown key; did you mean width?"),
        ("llm: {model: m}", "llm.url: missing; write url: https://api.example.org/v1"),
        ("llm: {url: 'https://x.example'}", "llm.model: missing; write model: small-model-1"),
        ("llm: {url: 'http://x.example', model: m}", "llm.url: must begin with https://, so that nobody on the way reads the key and what people say"),
        ("llm: {url: 'https://me:key@x.example', model: m}", "llm.url: must be without a name or a password; the key belongs into the variable LLM_KEY"),
        ("llm: {url: x.example, model: m}", 'llm.url: must be an address such as https://example.org/v1, not "x.example"'),
        ("llm: {url: 'https://x.example', model: m, system: ../p.txt}", "llm.system: must be a file below the folder of agent.py, such as prompts/warm.txt, not ../p.txt"),
        ("llm: {url: 'https://x.example', model: m, system: prompts/p.txt}", "llm.system: there is no file prompts/p.txt beside agent.py"),
        ("llm: {url: 'https://x.example', model: m, price: 3}", "llm.price: must be the price of a million tokens, such as {input: 0.5, output: 1.5}"),
        ("allowFramRateChange: 3", "allowFrameRateChange: must be true or false, not 3"),
        ("allowFrameRateChange: yes\nminFrameRate: 40\nmaxFrameRate: 20", "minFrameRate: must be at most maxFrameRate, which is 20, not 40"),
        ("allowFrameRateChange: yes\nstartingFrameRate: 100", "startingFrameRate: must be at most maxFrameRate, which is 90 by default, not 100; set maxFrameRate too"),
        ("allowFrameRateChange: yes\nstartingFrameRate: 5\nminFrameRate: 10", "startingFrameRate: must be at least minFrameRate, which is 10, not 5"),
        ("allowFrameRateChange: yes\nmaxFrameRate: 20", "maxFrameRate: must be at least startingFrameRate, which is 30 by default, not 20; set startingFrameRate too"),
        ("allowFrameRateChange: yes\nminFrameRate: 40", "minFrameRate: must be at most startingFrameRate, which is 30 by default, not 40; set startingFrameRate too"),
    ],
)  # fmt: skip
def test_a_wrong_value_under_trial_gets_a_message(folder: Path, trial: str, expected: str) -> None:
    assert only_mistake(folder, small(trial=trial + "\n")) == f"trial.{expected}"


@pytest.mark.parametrize("written", ["my-study", "my_study", "My_study-2", "a_", "-a", "7"])
def test_an_id_has_letters_digits_dashes_and_underscores(folder: Path, written: str) -> None:
    assert read(folder, SMALL.replace("id: small", f"id: {written}")).project.id == written


@pytest.mark.parametrize("written", ["[a]", "{a: b}", "yes", "…"])
def test_a_value_that_is_no_id_is_refused(folder: Path, written: str) -> None:
    assert only_mistake(folder, SMALL.replace("id: small", f"id: {written}")).startswith("project.id: m")


def test_folders_of_hippodrome_begin_with_an_underscore_and_ids_do_not() -> None:
    steps = [{"key": "1", "page": "hello"}, {"key": "2", "page": "bye"}]
    with pytest.raises(ConfigErrors, match='id: must not begin with an underscore; write for example "servers"'):
        parse_registration({"id": "_servers", "steps": steps})


def test_the_folder_of_the_certificate_is_no_project(folder: Path) -> None:
    """Servers may write nothing below SSL/: a study of this name would keep no answer of a game."""
    expected = "project.id: must not be SSL: that is the folder of the servers' certificate in the bucket"
    assert only_mistake(folder, SMALL.replace("id: small", "id: SSL")) == expected
    assert read(folder, SMALL.replace("id: small", "id: SSL-study")).project.id == "SSL-study"
    with pytest.raises(ConfigErrors, match="must not be SSL"):
        parse_registration({"id": "SSL", "steps": [{"key": "1", "page": "hello"}, {"key": "2", "page": "bye"}]})


def test_an_id_has_at_most_64_characters(folder: Path) -> None:
    assert read(folder, SMALL.replace("id: small", f"id: {'a' * 64}")).project.id == "a" * 64
    expected = "project.id: must be at most 64 characters long, not 65"
    assert only_mistake(folder, SMALL.replace("id: small", f"id: {'a' * 65}")) == expected


# Values against each other


def test_aws_needs_its_keys(folder: Path) -> None:
    assert mistakes(folder, small(project="useAWS: true\nawsSetup:\n  bucket:\n  region: eu-west-1\n")) == [
        "config.yml:8: project.awsSetup.cpu: missing; useAWS is true, so give the vCPUs of a server, such as 1",
        "config.yml:8: project.awsSetup.memory: missing; useAWS is true, so give the memory of a server in GB, such as 4",
    ]


def test_bucket_and_domain_may_be_left_to_the_installation(folder: Path) -> None:
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
def test_cpu_and_memory_may_be_a_size_of_fargate(folder: Path, cpu: float, memory: float) -> None:
    found = read(folder, aws(cpu, memory)).registration()["awsSetup"]
    assert (found["cpu"], found["memory"]) == (cpu, memory)


@pytest.mark.parametrize(
    ("cpu", "memory", "expected"),
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
def test_cpu_and_memory_that_are_no_size_of_fargate_are_refused(
    folder: Path, cpu: object, memory: object, expected: str
) -> None:
    assert only_mistake(folder, aws(cpu, memory)) == f"project.awsSetup.memory: {expected}"


@pytest.mark.parametrize(
    ("steps", "expected"),
    [
        ("1: consent\n3: thanks\n", "3: step 2 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ("1: consent\n5: thanks\n", "5: steps 2 to 4 are missing before it; number the steps 1, 2, 3 … without gaps"),
        ("2: consent\n", "2: step 1 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ("2: consent\nfinalStep: thanks\n", "2: step 1 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ("1: consent\ntwo: survey\n3: thanks\n", "two: a step's key is 1, 2, 3 … or finalStep"),
        ("1: consent\n02: thanks\n", "02: a step's key is 1, 2, 3 … or finalStep"),
        ("1: consent\nfinalstep: thanks\n", "finalstep: write finalStep"),
        ("1: consent\n501: thanks\n", "501: a project has at most 500 steps"),
        ("1: consent\n2: game\n", "2: the game cannot be the last step; add a page after it, which stops the server"),
        ("1: consent\nfinalStep: game\n", "finalStep: the game cannot be the last step; add a page after it, which stops the server"),
    ],
)  # fmt: skip
def test_steps_are_numbered_without_gaps_and_end_with_a_page(folder: Path, steps: str, expected: str) -> None:
    assert only_mistake(folder, small(steps=steps)) == f"project.steps.{expected}"


@pytest.mark.parametrize(
    ("events", "expected"),
    [
        ("startServerStep: 9", "startServerStep: there is no step 9; the steps are 1 to 4 and finalStep"),
        ("stopServerStep: 502", "stopServerStep: must be the number of a step or finalStep, not 502"),
        ("startServerStep: 5", "startServerStep: finalStep comes after the game, step 3, which needs the server; 2 is the usual choice"),
        ("startServerStep: 4", "startServerStep: step 4 comes after the game, step 3, which needs the server; 2 is the usual choice"),
        ("stopServerStep: 3", "stopServerStep: step 3 does not come after the game, step 3, which needs the server; use 4 or later"),
        ("stopServerStep: 1", "stopServerStep: step 1 does not come after the game, step 3, which needs the server; use 4 or later"),
    ],
)  # fmt: skip
def test_events_that_leave_the_game_without_a_server_are_refused(folder: Path, events: str, expected: str) -> None:
    steps = "1: consent\n2: survey\n3: game\n4: survey\nfinalStep: thanks\n"
    assert only_mistake(folder, small(steps=steps, project=f"events: {{{events}}}\n")) == f"project.events.{expected}"


def test_two_wrong_events_get_two_messages(folder: Path) -> None:
    text = small(
        steps="1: consent\n2: game\n3: thanks\n", project="events:\n  startServerStep: 3\n  stopServerStep: 1\n"
    )
    expected = ["which needs the server; 2 is the usual choice", "which needs the server; use 3 or later"]
    assert [line[-len(end) :] for line, end in zip(mistakes(folder, text), expected, strict=True)] == expected


def test_a_stop_step_before_the_start_step_is_refused(folder: Path) -> None:
    text = small(steps="1: consent\n2: thanks\n", project="events: {startServerStep: 2, stopServerStep: 1}\n")
    assert only_mistake(folder, text) == "project.events.stopServerStep: step 1 comes before startServerStep, step 2"
