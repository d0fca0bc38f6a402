from datetime import UTC, datetime, timedelta

from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import ids, participant
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.project import Events
from hippodrome.control.ports import Entry
from hippodrome.protocol.keys import answer_key, participant_folder
from testing.studies import SECRET, study

NOW = datetime(2026, 11, 21, tzinfo=UTC)
FOLDER = "maze/users/alice/"


def progress(*names: str) -> Progress:
    return Progress.from_listing(FOLDER, [Entry(FOLDER + name, NOW, 1) for name in sorted(names)])


def test_a_newcomer_stands_at_the_first_step() -> None:
    assert progress().due_step(study()).key == "1"
    assert not progress().has_arrived


def test_each_answer_moves_on_by_one_step_up_to_the_last() -> None:
    names = ["participant.json"]
    for answered, expected in [("1", "2"), ("2", "3"), ("3", "4"), ("4", "finalStep"), ("finalStep", "finalStep")]:
        names.append(f"answers/{answered}.json")
        assert progress(*names).due_step(study()).key == expected
    assert progress(*names).has_arrived


@given(st.sets(st.sampled_from(["1", "2", "3", "4", "finalStep", "99", "x"])))
def test_the_position_is_the_first_step_without_an_answer_whatever_other_answers_exist(keys: set[str]) -> None:
    here = progress(*[f"answers/{key}.json" for key in keys]).due_step(study()).key
    before = [step.key for step in study().steps[: study().index(here)]]
    assert set(before) <= keys
    assert here == "finalStep" or here not in keys


def test_a_listing_is_read_no_further_than_the_answers() -> None:
    read: list[str] = []

    def entries() -> object:
        for name in ("answers/1.json", "participant.json", "trials/a", "trials/b", "trials/c"):
            read.append(name)
            yield Entry(FOLDER + name, NOW, 1)

    Progress.from_listing(FOLDER, entries())  # type: ignore[arg-type]
    assert read == ["answers/1.json", "participant.json", "trials/a"]


def test_a_server_is_wanted_from_the_start_step_until_the_stop_step() -> None:
    project = study()
    assert [s.key for s in project.steps if participant.may_have_server(project, s)] == ["2", "3"]
    never = study(events=Events(None, None))
    assert not any(participant.may_have_server(never, s) for s in never.steps)


def test_consent_and_consent2_are_different_pages() -> None:
    project = study()
    assert project.file("alice", project.steps[0]) in ("consent-0", "consent-1")
    assert project.file("alice", project.steps[1]) == "questionnaire"


def test_an_answer_tells_which_page_and_group_it_came_from() -> None:
    project = study()
    record = participant.new_answer(project, "alice", project.steps[0], {"consent": "yes"}, NOW)
    assert record.page == f"consent-{record.group}"
    assert record.group == project.group("alice", project.steps[0])


def test_a_listing_tells_which_steps_were_answered_and_when() -> None:
    here = progress("participant.json", "answers/1.json", "answers/2.txt", "answers.json", "answers/x/y.json")
    assert here.has_arrived
    assert here.answered == {"1": NOW, "x/y": NOW}
    assert not progress("answers/1.json", "participant.jsonl").has_arrived


def test_a_participant_came_to_a_step_when_the_one_before_it_was_answered() -> None:
    project = study()
    here = Progress(True, {"1": NOW, "2": NOW + timedelta(minutes=1)})
    came = [here.reached_at(project, step) for step in project.steps]
    assert came == [None, NOW, NOW + timedelta(minutes=1), None, None]


def test_the_pages_of_the_last_minute_come_latest_first_and_games_not_at_all() -> None:
    project = study()
    ages = {"1": 59, "2": 60, "3": 5, "4": 10}
    here = Progress(True, {step: NOW - timedelta(seconds=age) for step, age in ages.items()})
    assert here.recently_answered(project, NOW) == ["4", "1"]
    many = study(steps=[Step(str(number), "survey") for number in range(12)])
    answered = {str(number): NOW - timedelta(seconds=number) for number in range(12)}
    assert Progress(True, answered).recently_answered(many, NOW) == [str(number) for number in range(10)]


def test_the_keys_of_a_participants_documents() -> None:
    assert participant_folder("maze", "alice") == FOLDER
    assert participant.participant_key("maze", "alice") == f"{FOLDER}participant.json"
    assert answer_key("maze", "alice", "2") == f"{FOLDER}answers/2.json"


def test_a_new_participant_gets_a_group_and_a_code_and_keeps_the_fields_of_the_link() -> None:
    project = study()
    assert participant.new_participant(project, "alice", {"SESSION_ID": "7"}, NOW) == participant.Participant(
        project_id="maze",
        user_id="alice",
        arrived=NOW,
        group=project.group("alice"),
        completion_code=ids.completion_code(SECRET, "alice"),
        link={"SESSION_ID": "7"},
    )


def test_an_answer_holds_the_form_and_its_time() -> None:
    project = study()
    record = participant.new_answer(project, "alice", project.steps[1], {"age": "3"}, NOW)
    assert (record.step, record.page, record.answered, record.answers, record.schema) == (
        "2",
        "questionnaire",
        NOW,
        {"age": "3"},
        1,
    )


def test_two_forms_are_the_same_in_any_order_of_their_fields() -> None:
    assert participant.same_answers({"a": "1", "b": ["2", "3"]}, {"b": ["2", "3"], "a": "1"})
    assert not participant.same_answers({"a": ["1", "2"]}, {"a": ["2", "1"]})


def test_the_steps_at_which_something_happens() -> None:
    project = study()
    steps = {step.key: step for step in project.steps}
    assert [key for key, step in steps.items() if participant.starts_server(project, step)] == ["2"]
    assert [key for key, step in steps.items() if participant.stops_server(project, step)] == ["4"]


def test_without_a_stop_step_a_server_is_wanted_to_the_end() -> None:
    project = study(events=Events("3", None))
    assert [s.key for s in project.steps if participant.may_have_server(project, s)] == ["3", "4", "finalStep"]
    assert not participant.may_have_server(project, Step("unknown", "x"))
    from_the_first = study(events=Events("1", "2"))
    assert [s.key for s in from_the_first.steps if participant.may_have_server(from_the_first, s)] == ["1"]
    assert not any(participant.may_have_server(study(events=Events("9", "4")), s) for s in project.steps)
