from datetime import UTC, datetime

from hypothesis import given
from hypothesis import strategies as st

from hippodrome import participant
from hippodrome.participant import Progress
from hippodrome.platform import Entry
from hippodrome.project import Events
from tests.studies import study

NOW = datetime(2026, 11, 21, tzinfo=UTC)
FOLDER = "maze/users/alice/"


def progress(*names: str) -> Progress:
    return Progress.of(FOLDER, [Entry(FOLDER + name, NOW, 1) for name in sorted(names)])


def test_a_newcomer_stands_at_the_first_step() -> None:
    assert progress().position(study()).key == "1"
    assert not progress().known


def test_each_answer_moves_on_by_one_step_up_to_the_last() -> None:
    names = ["participant.json"]
    for answered, expected in [("1", "2"), ("2", "3"), ("3", "4"), ("4", "finalStep"), ("finalStep", "finalStep")]:
        names.append(f"answers/{answered}.json")
        assert progress(*names).position(study()).key == expected
    assert progress(*names).known


@given(st.sets(st.sampled_from(["1", "2", "3", "4", "finalStep", "99", "x"])))
def test_the_position_is_the_first_step_without_an_answer_whatever_else_lies_there(keys: set[str]) -> None:
    here = progress(*[f"answers/{key}.json" for key in keys]).position(study()).key
    before = [step.key for step in study().steps[: study().index(here)]]
    assert set(before) <= keys
    assert here == "finalStep" or here not in keys


def test_a_listing_is_read_no_further_than_the_answers() -> None:
    read: list[str] = []

    def entries() -> object:
        for name in ("answers/1.json", "participant.json", "trials/a", "trials/b", "trials/c"):
            read.append(name)
            yield Entry(FOLDER + name, NOW, 1)

    Progress.of(FOLDER, entries())  # type: ignore[arg-type]
    assert read == ["answers/1.json", "participant.json", "trials/a"]


def test_a_server_is_wanted_from_the_start_step_until_the_stop_step() -> None:
    project = study()
    assert [s.key for s in project.steps if participant.wants_server(project, s)] == ["2", "3"]
    never = study(events=Events(None, None))
    assert not any(participant.wants_server(never, s) for s in never.steps)


def test_consent_and_consent2_are_different_pages() -> None:
    project = study()
    assert project.file("alice", project.steps[0]) in ("consent-0", "consent-1")
    assert project.file("alice", project.steps[1]) == "questionnaire"


def test_an_answer_tells_which_page_and_group_it_came_from() -> None:
    project = study()
    record = participant.answer(project, "alice", project.steps[0], {"consent": "yes"}, NOW)
    assert record.page == f"consent-{record.group}"
    assert record.group == project.group("alice", project.steps[0])
