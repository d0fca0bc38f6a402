"""The registration of a project folder, its check by the function, and the schema for editors."""

from __future__ import annotations

import copy
import json
import string
import subprocess
import sys
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from hippodrome.control.config import (
    ConfigErrors,
    config_schema,
    fargate,
    parse_registration,
    project_keys,
    read_project,
)
from hippodrome.control.config.__main__ import main
from hippodrome.control.config.yaml_file import parse_yaml
from hippodrome.control.model.project import Project
from hippodrome.deployment.core.project_folder import may_use_aws
from hippodrome.protocol import section_keys, trial
from tests.control.config import tables

DOCS = Path(__file__).parents[3] / "docs"

EXAMPLE = """\
project:
  id: maze-study
  name: The maze
  researcher: Kim
  teamMembers:
  useAWS: true
  awsSetup: {bucket: maze-lab, region: eu-west-1, rootDomain: maze.example, cpu: 0.5, memory: 2}
  ssl: {sslBucket: maze-lab, fullchain: tls/fullchain.pem, privkey: tls/privkey.pem}
  allowedHosts: [https://media.maze.example, "https://cdn.example:8443"]
  steps:
    1: consent.html
    2: rules
    3: game
    finalStep: thanks.html
trial:
  game: Maze-v0
  actionSpace:
  startingFrameRate: 20
  ui: {up: true, down: true, left: true, right: true, good: true}
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A project without mistakes."""
    (tmp_path / "steps").mkdir()
    for page in ("consent", "rules-0", "rules-1", "thanks"):
        (tmp_path / "steps" / f"{page}.html").write_text("<p>")
    (tmp_path / "config.yml").write_text(EXAMPLE)
    return tmp_path


@pytest.fixture
def registration(folder: Path) -> dict[str, Any]:
    return read_project(folder).registration()


def refused(data: object) -> list[str]:
    with pytest.raises(ConfigErrors) as caught:
        parse_registration(data)
    assert all(problem.file == "message" and problem.line is None for problem in caught.value.diagnostics)
    return str(caught.value).splitlines()


# --- a registration and its check -------------------------------------------------------------------


def test_a_registration_is_unchanged_after_json_and_its_own_check(registration: dict[str, Any]) -> None:
    assert parse_registration(json.loads(json.dumps(registration))) == registration


def test_warm_servers_are_registered(folder: Path) -> None:
    (folder / "config.yml").write_text(EXAMPLE.replace("  name:", "  warmServers: 4\n  name:"))
    registration = read_project(folder).registration()
    assert msgspec.convert(parse_registration(registration), Project).warm_servers == 4


def test_a_registration_converts_to_a_project(registration: dict[str, Any]) -> None:
    project = msgspec.convert(registration, Project)
    assert [(step.key, step.page, step.variants) for step in project.steps][1] == ("2", "rules", 2)
    assert project.final.page == "thanks"
    assert (project.events.start_server_step, project.events.stop_server_step) == ("2", "finalStep")
    assert (project.size.cpu, project.size.memory) == (0.5, 2)
    assert project.allowed_hosts == ["https://media.maze.example", "https://cdn.example:8443"]
    assert project.trial["ui"]["good"] is True
    assert project.trial["ui"]["start"] is False


def test_checking_does_not_change_the_message(registration: dict[str, Any]) -> None:
    before = copy.deepcopy(registration)
    parse_registration(registration)
    assert registration == before


def test_keys_that_a_message_leaves_out_have_their_defaults() -> None:
    found = parse_registration({"id": "a", "steps": [{"key": "1", "page": "consent"}]})
    assert (found["live"], found["cluster"], found["trial"]["maxEpisodes"]) == (True, "installation", 20)
    assert found["steps"] == [{"key": "1", "page": "consent", "variants": 0}]


def test_a_task_definition_is_passed_on(registration: dict[str, Any]) -> None:
    assert "taskDefinition" not in registration
    for name in ("maze:7", "arn:aws:ecs:eu-west-1:123456789012:task-definition/maze_a.b:12", "x" * 255):
        found = parse_registration(registration | {"taskDefinition": name})
        assert found == registration | {"taskDefinition": name}
        assert msgspec.convert(found, Project).task_definition == name


def test_the_port_of_the_servers_is_passed_on_and_that_of_earlier_registrations_is_hippos(
    registration: dict[str, Any],
) -> None:
    for port in (443, 5000):
        found = parse_registration(registration | {"serverPort": port})
        assert found == registration | {"serverPort": port}
        assert msgspec.convert(found, Project).server_port == port
    assert msgspec.convert(parse_registration(registration), Project).server_port == 5000


def test_a_researcher_cannot_choose_the_task_definition(folder: Path) -> None:
    (folder / "config.yml").write_text(EXAMPLE.replace("project:", "project:\n  taskDefinition: maze"))
    assert "taskDefinition" not in read_project(folder).registration()


def test_options_are_registered_unchanged(registration: dict[str, Any]) -> None:
    options = {"a": [1, 2.5, True, None, {"b": "ü", "": []}], "maxEpisodes": "mine", "": -(2**53)}
    registration["trial"]["options"] = options
    found = parse_registration(registration)
    assert found["trial"]["options"] == options
    assert (
        msgspec.json.decode(msgspec.json.encode(msgspec.convert(found, Project)), type=Project).trial == found["trial"]
    )


def test_reading_a_registration_needs_no_yaml() -> None:
    code = "import sys, hippodrome.control.config; sys.exit('yaml' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=DOCS.parent, check=False).returncode == 0


names = st.text(string.ascii_letters + string.digits + "-", min_size=1, max_size=64)
words = st.text(string.ascii_letters + string.digits + " äß漢", min_size=1, max_size=20).map(str.strip).filter(bool)
pages = st.text(string.ascii_lowercase + string.digits + "_-", min_size=1, max_size=12).filter(
    lambda page: page != "game" and page[0] != "-"
)


@st.composite
def registrations(draw: st.DrawFn) -> dict[str, Any]:
    """A correct registration of any kind of project."""
    order = [*draw(st.lists(st.one_of(st.just("game"), pages), max_size=8)), draw(pages)]
    steps = [{"key": str(k), "page": page, "variants": 0} for k, page in enumerate(order, 1)]
    for step in steps:
        if step["page"] != "game":
            step["variants"] = draw(st.integers(0, 5))
    if len(steps) > 1 and order[-1] != order[-2] and draw(st.booleans()):
        steps[-1]["key"] = "finalStep"
    cpu = draw(st.sampled_from(sorted(fargate.SIZES)))
    use_aws = draw(st.booleans())
    rates = sorted(draw(st.tuples(*[st.integers(1, 240)] * 3)))
    return {
        "id": draw(names),
        "name": draw(words),
        "researcher": draw(words),
        "teamMembers": draw(st.lists(words, max_size=3)),
        "live": draw(st.booleans()),
        "maxRuntime": draw(st.integers(1, 1440)),
        "useAWS": use_aws,
        "awsSetup": {
            "bucket": "a-bucket",
            "region": "eu-west-1",
            "rootDomain": "a.example",
            "cpu": cpu,
            "memory": draw(st.sampled_from(fargate.SIZES[cpu])),
        }
        if use_aws
        else None,
        "steps": steps,
        "cluster": draw(st.sampled_from(["installation", "participant"])),
        "subdomain": draw(st.sampled_from(["hash", "userId"])),
        "trial": {
            "game": draw(words),
            "actionSpace": draw(st.lists(words, max_size=4, unique=True)),
            "minFrameRate": rates[0],
            "startingFrameRate": rates[1],
            "maxFrameRate": rates[2],
            "ui": draw(
                st.dictionaries(st.sampled_from(sorted(section_keys.names(trial.Ui))), st.booleans(), min_size=1)
            ),
            "options": draw(
                st.dictionaries(words, words | st.integers(-(2**53), 2**53) | st.lists(st.booleans()), max_size=4)
            ),
        },
    }


@given(registrations())
def test_a_correct_registration_stays_the_same_when_it_is_checked_again(data: dict[str, Any]) -> None:
    first = parse_registration(data)
    assert parse_registration(json.loads(json.dumps(first))) == first
    for key in ("id", "name", "researcher", "teamMembers", "live", "maxRuntime", "awsSetup", "steps"):
        assert first[key] == data[key]
    assert first["trial"]["options"] == data["trial"]["options"]


# --- messages from outside --------------------------------------------------------------------------


@pytest.mark.parametrize("data", [None, [], "project", 3, True])
def test_a_message_is_an_object(data: object) -> None:
    assert refused(data) == ["message: a registration must be a JSON object"]


def test_an_empty_message_gets_a_message_for_each_necessary_key() -> None:
    assert refused({}) == [
        "message: id: missing; give the project an id of letters, digits, dashes and underscores",
        "message: steps: must be a list of 1 to 500 steps",
    ]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"id": "../etc"}, 'id: may hold only letters, digits, dashes and underscores, not "../etc"; write for example "etc"'),
        ({"id": {"$ne": ""}}, "id: must be letters, digits, dashes and underscores, not a map"),
        ({"secret": "x"}, "secret: unknown key; docs/config.md lists all keys"),
        ({"maxRuntime": 10**400}, "maxRuntime: must be a whole number from 1 to 1440, not such a value"),
        ({"maxRuntime": float("nan")}, "maxRuntime: must be a whole number from 1 to 1440, not NaN"),
        ({"allowedHosts": ["https://a.example; script-src *"]}, 'allowedHosts item 1: must be an address such as https://example.org, without path and without *, not "https://a.example; script-src *"'),
        ({"events": {"stopServerStep": "7"}}, "events.stopServerStep: there is no step 7; the steps are 1 to 3 and finalStep"),
        ({"awsSetup": None}, "awsSetup.cpu: missing; useAWS is true, so give the vCPUs of a server, such as 1"),
        ({"steps": "consent"}, "steps: must be a list of 1 to 500 steps"),
        ({"steps": [{"key": "1", "page": "a"}] * 502}, "steps: must be a list of 1 to 500 steps"),
        ({"steps": ["consent"]}, 'steps item 1: must be a section: indented lines such as "key: value" below it, not "consent"'),
        ({"steps": [{"key": "1"}]}, "steps item 1: must have key and page"),
        ({"steps": [{"key": "1", "page": "game", "variants": 2}, {"key": "2", "page": "a"}]}, "steps item 1: is a game step, so it cannot have variants; leave them out"),
        ({"steps": [{"key": "1", "page": "../a"}]}, 'steps item 1.page: must be the name of a file in the steps folder, without folders, not "../a"'),
        ({"steps": [{"key": "1", "page": "a", "variants": -1}]}, "steps item 1.variants: must be a whole number from 0 to 1000, not -1"),
        ({"steps": [{"key": "1", "page": "a", "file": "b"}]}, "steps item 1.file: unknown key"),
        ({"steps": [{"key": "2", "page": "a"}, {"key": "1", "page": "a"}]}, "steps: must be in order, 1, 2, 3 … and perhaps finalStep, each once"),
        ({"steps": [{"key": "1", "page": "a"}, {"key": "1", "page": "b"}]}, "steps: must be in order, 1, 2, 3 … and perhaps finalStep, each once"),
        ({"steps": [{"key": "1", "page": "a"}, {"key": "3", "page": "b"}], "events": None}, "steps item 2: step 2 is missing before it; number the steps 1, 2, 3 … without gaps"),
        ({"steps": [{"key": "1", "page": "game"}], "events": None}, "steps item 1: the game cannot be the last step; add a page after it, which stops the server"),
        *(
            ({"taskDefinition": wrong}, "taskDefinition: must be the name or ARN of a task definition: 1 to 255 letters, digits and :/_.-")
            for wrong in ("", "a b", "x" * 256, "maze:7\n", "mäze", None, 7, ["maze"])
        ),
        *(({"serverPort": wrong}, "serverPort: must be 443 or 5000") for wrong in (0, 80, "443", None, True, 443.5, [])),
        ({"taskDefinition": "", "maxRuntime": 0}, "maxRuntime: must be a whole number from 1 to 1440, not 0"),
        *(
            ({"trial": {"options": {"a": [wrong]}}}, "trial.options: must be text, numbers, true or false, lists and maps; one of the values is none of these")
            for wrong in (float("nan"), float("inf"), 10**400, 2**63, "\ud800", {"\udfff": 1})
        ),
        ({"trial": {"maxEpisodes": "x"}}, 'trial.maxEpisodes: must be a whole number from 1 to 1000000, not "x"'),
        ({"trial": "x"}, 'trial: must be a section: indented lines such as "actionBufferLifespan: …" below it, not "x"'),
    ],
)  # fmt: skip
def test_a_wrong_message_is_refused(registration: dict[str, Any], change: dict[str, Any], expected: str) -> None:
    assert f"message: {expected}" in refused(registration | change)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(exclude_categories=[])),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(st.characters(exclude_categories=[])), inner, max_size=4)
    ),
    max_leaves=12,
)
known_keys = st.sampled_from(
    sorted(
        section_keys.names(project_keys.ProjectKeys)
        | {"trial"}
        | section_keys.names(trial.TrialSection)
        | section_keys.names(project_keys.AwsSetupKeys)
        | {"1", "2", "finalStep"}
    )
)


@given(st.dictionaries(known_keys | st.text(), json_values, max_size=8) | json_values)
def test_any_message_is_accepted_or_raises_config_errors(data: object) -> None:
    try:
        found = parse_registration(data)
    except ConfigErrors as errors:
        assert errors.diagnostics
        str(errors).encode()
    else:
        assert parse_registration(found) == found


@given(registrations(), known_keys, json_values)
def test_a_damaged_registration_is_accepted_or_raises_config_errors(
    data: dict[str, Any], key: str, value: object
) -> None:
    for spoilt in (
        data | {key: value},
        data | {"trial": data["trial"] | {key: value}},
        data | {"steps": [*data["steps"], value]},
    ):
        try:
            found = parse_registration(spoilt)
        except ConfigErrors as errors:
            assert errors.diagnostics
        else:
            json.dumps(found).encode()


def test_a_message_with_very_many_keys_is_refused_in_time(registration: dict[str, Any]) -> None:
    assert len(refused(registration | {f"key{n}": n for n in range(20_000)})) == 20_000


def test_a_message_that_is_nested_too_deeply_is_refused(registration: dict[str, Any]) -> None:
    deep: Any = "x"
    for _ in range(50_000):
        deep = [deep]
    for key in ("id", "steps", "trial", "teamMembers", "other", "taskDefinition"):
        assert refused(registration | {key: deep})
    assert refused(registration | {"trial": {"game": "x", "options": {"a": deep}}}) == [
        "message: trial.options: must be nested no more than 8 deep",
    ]
    assert refused(registration | {"steps": [{"key": "1", "page": deep}]})
    assert refused(registration | {"trial": {"ui": {"left": {"a": deep}}}})


# --- files from outside -----------------------------------------------------------------------------


yaml_text = st.text(st.sampled_from("\n\n    ::-[]{}#&*!|>'\"%@`?,\t\\abn1~.=<\u00e9\ufeff"), max_size=60)
lines = st.lists(
    st.sampled_from([*EXAMPLE.splitlines(), "  - a", "    1: *a", "  x: &a y", "\tz: 1", "---"]), max_size=20
)
trees = st.dictionaries(
    known_keys | st.sampled_from(["project", "trial"]) | st.text(max_size=5), json_values, max_size=5
)


@given(
    st.binary(max_size=200)
    | yaml_text.map(str.encode)
    | lines.map(lambda found: "\n".join(found).encode())
    | st.dictionaries(st.sampled_from(["project", "trial"]), trees | json_values).map(
        lambda tree: yaml.safe_dump(tree).encode()
    )
)
@example(b"%YAML 99999999999999999999.1\n---\na: 1")
@example(b'a: "\\UFFFFFFFF"')
@example(b'project: {"\\ud800": 1, id: "\\ud800", steps: {"\\ud800": "\\ud800"}}')
@example(b"project: {steps: {1: !!binary x, 2: !!int y, 3: !!float z, 4: !!null w, 5: !!bool v}}")
@example(b"project: {? : x, ~: y, 1.5: z, 2001-01-01: w}")
@example(b"? &a [*a]\n: *a")
def test_any_file_is_accepted_or_raises_config_errors(folder: Path, data: bytes) -> None:
    (folder / "config.yml").write_bytes(data)
    try:
        found = read_project(folder)
    except ConfigErrors as errors:
        assert errors.diagnostics
        assert all(str(problem).isprintable() for problem in errors.diagnostics)
    else:
        assert parse_registration(found.registration()) == found.registration()


# --- the schema -------------------------------------------------------------------------------------


def as_an_editor_sees_it(text: str) -> Any:
    """YAML as JSON: keys are text."""
    return json.loads(json.dumps(yaml.safe_load(text)))


def test_the_schema_accepts_configurations_that_are_accepted(folder: Path) -> None:
    schema = config_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.validate(as_an_editor_sees_it((folder / "config.yml").read_text()), schema)


def test_the_schema_accepts_a_projects_own_control(folder: Path) -> None:
    text = EXAMPLE.replace("good: true", "good: true, reallyGood: true, dull: false, hue: , toggle: false")
    (folder / "config.yml").write_text(text)
    assert read_project(folder).trial.ui.own == ("reallyGood",)
    jsonschema.validate(as_an_editor_sees_it(text), config_schema())


@pytest.mark.parametrize(
    "text",
    [
        EXAMPLE.replace("good: true", f"{'x' * 65}: true"),
        EXAMPLE.replace("good: true", "toggle: true"),
        EXAMPLE.replace("id:", "ident:"),
        EXAMPLE.replace("startingFrameRate: 20", "startingFrameRate: fast"),
        EXAMPLE.replace("startingFrameRate: 20", "startingFrameRate: 0"),
        EXAMPLE.replace("    2: rules", "    two: rules"),
        EXAMPLE.replace("cpu: 0.5", "cpu: 3"),
        "trial: {}",
    ],
)
def test_the_schema_refuses_configurations_that_are_refused(folder: Path, text: str) -> None:
    (folder / "config.yml").write_text(text)
    with pytest.raises(ConfigErrors):
        read_project(folder)
    assert not jsonschema.Draft202012Validator(config_schema()).is_valid(as_an_editor_sees_it(text))


def test_the_schema_in_the_docs_is_the_current_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema"]) == 0
    assert capsys.readouterr().out == tables.SCHEMA.read_text(encoding="utf-8") == tables.schema()


@pytest.mark.parametrize("page", tables.PAGES, ids=lambda page: page.name)
def test_the_tables_of_keys_in_the_docs_are_the_current_ones(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert tables.page_with_tables(text) == text


def test_a_key_that_the_docs_lack_gets_a_row_below_the_one_declared_before_it() -> None:
    text = tables.PAGES[0].read_text(encoding="utf-8")
    rows = text.splitlines(keepends=True)
    without = "".join(row for row in rows if not row.startswith("| `seats`"))
    assert "`seats`" not in without
    assert tables.page_with_tables(without) == text


def test_every_example_of_a_value_is_accepted() -> None:
    for path, section in project_keys.SECTIONS.items():
        for key in section_keys.keys(section):
            if key.example and (*path, key.name) != project_keys.STEPS:  # config/design.py reads a list of steps
                document = parse_yaml(f"{key.name}: {key.example}".encode()).values
                assert section_keys.check_section(section, document, path)[1] == [], key.name


def test_the_schema_says_what_every_key_means() -> None:
    for name, section in config_schema()["$defs"].items():
        for key, prop in section["properties"].items():
            assert name == "Ui" or prop["description"].endswith("."), f"{name}.{key}"


def test_the_examples_in_the_reference_are_right(folder: Path) -> None:
    study, on_aws = (DOCS / "config.md").read_text(encoding="utf-8").split("```yaml\n")[1:3]
    text = study.split("```")[0].replace("trial:", on_aws.split("```")[0] + "trial:")
    for page in ("briefing-0", "briefing-1", "survey"):
        (folder / "steps" / f"{page}.html").touch()
    (folder / "config.yml").write_text(text, encoding="utf-8")
    found = read_project(folder)
    size = found.project.aws_setup
    assert (may_use_aws(folder), size.cpu, size.memory, found.steps[1].variants) == (True, 1, 4, 2)
