"""What a registered project says of its steps, groups and sizes."""

from __future__ import annotations

import msgspec
import pytest

from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import AwsSetup, Events, MasterList, Project, step_key
from hippodrome.control.model.records import from_json, to_json
from testing.studies import SECRET, study


def test_steps_are_found_by_their_keys() -> None:
    project = study()
    assert [project.index(key) for key in ("1", "4", "finalStep", "5", "")] == [0, 3, 4, None, None]
    assert [step and step.page for step in map(project.step, ("1", "finalStep", "5", None))] == [
        "consent",
        "debrief",
        None,
        None,
    ]
    assert (project.final.key, project.game_steps) == ("finalStep", ["3"])
    assert [step.type.on_server for step in project.steps] == [False, False, True, False, False]


def test_a_ticket_proves_the_step_that_was_shown() -> None:
    project, ticket = study(), ids.ticket(SECRET, "alice", "2")
    assert project.step_of_ticket("alice", "2", ticket) == project.steps[1]
    for user, step, proof in (
        ("bob", "2", ticket),
        ("alice", "1", ticket),
        ("alice", "9", ids.ticket(SECRET, "alice", "9")),
    ):
        assert project.step_of_ticket(user, step, proof) is None
    for step, proof in (("2", None), ("2", ""), (None, ticket)):
        assert project.step_of_ticket("alice", step, proof) is None


def test_a_step_with_variants_shows_the_file_of_the_participants_group() -> None:
    project = study(steps=[Step("1", "a", 2), Step("2", "b"), Step("3", "c", 3), Step("finalStep", "d")])
    for user in ("alice", "bob", "carol", "dave", "erin"):
        two, three = ids.group("maze", user, 2), ids.group("maze", user, 3)
        assert [project.file(user, step) for step in project.steps] == [f"a-{two}", "b", f"c-{three}", "d"]
        assert [project.group(user, step) for step in project.steps] == [two, three, three, three]
        assert project.group(user) == three, "the study's groups are those of the step with the most"
    assert study(steps=[Step("finalStep", "d")]).group("alice") is None
    assert study(steps=[]).group("alice") is None


def test_the_default_size_is_the_smallest_for_a_game() -> None:
    assert (study(aws_setup=None).size.cpu, study(aws_setup=None).size.memory) == (1, 2)
    assert study(aws_setup=AwsSetup(cpu=4, memory=8)).size == AwsSetup(cpu=4, memory=8)


@pytest.mark.parametrize(
    ("limits", "counts"),
    [({}, False), ({"max_servers": 0}, True), ({"max_server_hours": 0}, True), ({"max_participants": 1}, False)],
)
def test_servers_are_counted_where_one_of_their_limits_is_set(limits: dict[str, int], counts: bool) -> None:
    assert study(**limits).limits_servers is counts


def test_a_project_is_entered_into_the_list_by_its_id() -> None:
    listed = MasterList([study(id="b"), study(id="d")])
    for added in (study(id="a"), study(id="c"), study(id="e")):
        assert [p.id for p in listed.with_project(added).projects] == sorted(["b", "d", added.id])
    renamed = listed.with_project(study(id="b", name="New"))
    assert [(p.id, p.name) for p in renamed.projects] == [("b", "New"), ("d", "A maze")]
    assert (renamed.find("b"), renamed.find("x")) == (renamed.projects[0], None)


def test_the_keys_of_step_pages() -> None:
    assert step_key("maze", "consent-0") == "maze/steps/consent-0.html"
    assert study().page_key("consent-0") == "maze/steps/consent-0.html"
    assert study(page_folder="").page_key("consent-0") == "maze/consent-0.html"


def test_fields_that_a_registration_leaves_out_have_their_defaults() -> None:
    assert msgspec.structs.asdict(from_json(b'{"id": "maze", "steps": []}', Project)) == {
        "id": "maze",
        "steps": [],
        "conditions": (),
        "blocks": (),
        "ends": (),
        "name": "",
        "researcher": "",
        "contact": "",
        "team_members": [],
        "live": False,
        "max_runtime": 60,
        "use_a_w_s": False,
        "aws_setup": None,
        "events": Events(None, None),
        "cluster": "installation",
        "subdomain": "hash",
        "plain_clients": False,
        "front_end": [],
        "allowed_hosts": [],
        "record_headers": [],
        "max_participants": None,
        "max_servers": None,
        "max_server_hours": None,
        "warm_servers": 0,
        "signed_links": False,
        "players": 1,
        "other_numbers": (),
        "matching": "arrival",
        "patience": 300,
        "seats": "lot",
        "after_patience": "unmatched",
        "texts": {},
        "trial": {},
        "task_definition": None,
        "page_folder": "steps",
        "game_pages": {},
        "server_port": 5000,
        "version": "",
        "salt": "",
        "secret": "",
    }
    assert from_json(b'{"key": "1", "page": "a"}', Step).variants == 0
    assert from_json(b'{"id": "maze", "steps": [], "useAWS": true}', Project).use_a_w_s is True


# ---- another number of players


def test_a_registration_keeps_the_last_registration_for_each_other_number_of_players() -> None:
    two = study(players=2, trial={"game": "two"}, task_definition="two:1", server_port=443)
    three = study(players=3, trial={"game": "three"}, warm_servers=2).following(two)
    again = study(players=3, trial={"game": "three, mended"}).following(three)
    four = study(players=4, trial={"game": "four"}, game_pages={"instructions": 2}).following(again)
    assert [each.players for each in four.other_numbers] == [2, 3]
    assert [four.for_session(players) for players in (0, 4, 5)] == [four, four, None]
    for players, game, task, port in ((2, "two", "two:1", 443), (3, "three, mended", None, 5000)):
        found = four.for_session(players)
        assert found is not None
        assert (found.players, found.trial, found.task_definition, found.server_port) == (players, {"game": game}, task, port)  # fmt: skip
        assert found.steps == four.steps
    assert four.following(four).other_numbers == four.other_numbers
    assert [each.players for each in study(players=2).following(four).other_numbers] == [3, 4]
    assert from_json(to_json(four), Project) == four


def test_a_session_of_another_number_gets_no_warm_server() -> None:
    found = study(players=3, warm_servers=2).following(study(players=2, warm_servers=1)).for_session(2)
    assert found is not None
    assert found.warm_servers == 0


def test_a_first_registration_keeps_nothing() -> None:
    assert study(players=2).following(None).other_numbers == ()
    assert study().following(study()).other_numbers == ()


def test_a_participant_who_plays_alone_goes_on_with_the_registration_for_one_player() -> None:
    found = study(players=2, trial={"game": "two"}).following(study(trial={"game": "one"})).for_session(1)
    assert found is not None
    assert (found.has_sessions, found.trial) == (False, {"game": "one"})
