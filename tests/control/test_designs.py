"""What participants meet in studies with a design: checks, ends, conditions, and steps that are repeated."""

from __future__ import annotations

import html
import json
import re
from collections import Counter
from pathlib import Path
from random import Random
from typing import Any

import pytest

from hippodrome.control import registry
from hippodrome.control.config import read_project
from hippodrome.control.model import server
from hippodrome.control.model.design import latin_rows
from hippodrome.control.model.project import step_key
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import Conflict, Topic
from testing.designed import DesignedStudy, write
from testing.fake_platform import FakePlatform
from testing.visitors import Browser

PAGES = {
    "consent": "<h1>Consent</h1><input name='agree'><button>Go on</button>",
    "quiz": "<h1>Quiz</h1><p>{{ wrong | join(' ') }}</p><input name='soups'><input name='late'><button>Go on</button>",
    "rate": "<h1>Rate</h1><p>look {{ condition.look }} run {{ run.position }}</p><input name='q1'><button>Go on</button>",
    "debrief": "<h1>Thanks</h1>{{ completion_code }} {{ condition.partner }} {{ order.look | join(',') }}",
}
SOUP = """
project:
  id: soup
  conditions: {partner: [helpful, lazy], advice: [on, off]}
  steps:
    - consent
    - quiz: {right: {soups: 3, late: no}, tries: 2}
    - game
    - debrief
  ends:
    declined: answers.consent.agree == "no"
    screenedOut: {when: not answers.quiz.passed, code: CS1, link: "https://example.org/back"}
    late: {minutes: 60}
trial:
  game: kitchen
  players: {human: human, partner: "policies/{partner}.onnx"}
  options: {advice: "{advice}", fixed: 1}
"""
LOOKS = """
project:
  id: looks
  steps:
    - consent
    - each: {look: [plain, face, voice]}
      steps: [game: {options: {look: "{look}"}, maxEpisodes: 2}, rate]
    - debrief
trial: {game: kitchen, maxEpisodes: 5}
"""


SITTINGS = """
project:
  id: days
  live: true
  steps:
    - consent
    - game
    - tomorrow: {minSeconds: 86400}
    - game2: {maxEpisodes: 2}
    - debrief
trial: {game: kitchen}
"""


@pytest.fixture
def platform() -> FakePlatform:
    from hippodrome.functions import installed

    made = FakePlatform()
    installed.use(made)
    return made


def study(config: str, tmp_path: Path, platform: FakePlatform) -> DesignedStudy:
    folder = write(tmp_path / "study", config, PAGES)
    (folder / "policies").mkdir()
    for name in ("helpful", "lazy"):
        (folder / "policies" / f"{name}.onnx").touch()
    return DesignedStudy(folder, platform)


def heading(page: str) -> str:
    found = re.search(r"<h1[^>]*>(.*?)</h1>", page)
    assert found, page
    return found[1]


def started(study: DesignedStudy, user: str, attempt: int, before: Server | None = None) -> Server:
    """Store the record of a server that is being started."""
    platform = study.platform
    made = server.new_attempt(study.project, user, attempt, settings=platform.settings, now=platform.now())
    record = server.replacing(server.close(before, Reason.ENDED, platform.now()), made) if before else made
    platform.documents.put(server.key(record.label), to_json(record))
    return record


def topics(platform: FakePlatform) -> list[Topic]:
    return [topic for topic, _ in platform.bus.sent]


# Ends


def test_who_declines_is_asked_nothing_more_and_gets_no_server(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    alice = soup.visitor("alice")
    alice.answer(alice.get(), agree="no")
    page = alice.get()
    assert heading(page) == "Thank you"
    end = soup.stored("alice", "end")
    assert (end["end"], end["code"] in page) == ("declined", True)
    assert ('class="study">soup<' in page, "TEXT.copy" not in page, '"Copy"' in page) == (True, True, True)
    assert topics(platform) == [Topic.STOP], "no server was requested"
    alice.post(agree="yes")
    assert heading(alice.get()) == "Thank you"
    assert soup.answers("alice") == {"consent": {"agree": "no"}}


def test_who_fails_the_check_twice_gets_the_ends_code_and_link(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    alice = soup.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    first = alice.get()
    alice.answer(first, soups="2", late="no")
    page = alice.get()
    assert "One answer is not correct yet. You have one attempt left." in page
    assert "<p>soups</p>" in page, "the page may say which"
    alice.answer(first, soups="3", late="no")
    assert "One answer is not correct yet." in alice.get(), "going back gives no further try"
    alice.answer(page, soups="4", late="yes")
    page = alice.get()
    assert "CS1" in page
    assert 'href="https://example.org/back"' in page
    assert soup.answers("alice")["quiz"] == {"soups": "4", "late": "yes", "passed": False, "tries": 2}
    assert soup.answers("alice")["quiz.1"] == {"soups": "2", "late": "no"}


def test_who_is_right_goes_on(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    alice = soup.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    alice.answer(alice.get(), soups=" 3", late="NO")
    assert "queued" in alice.get()
    assert soup.answers("alice")["quiz"]["passed"] is True
    assert "3" not in "".join(PAGES["quiz"]), "the right answers stand in config.yml only"


def test_time_runs_out_between_steps_and_not_in_a_game(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    alice, bob = soup.visitor("alice"), soup.visitor("bob")
    for person in (alice, bob):
        person.answer(person.get(), agree="yes")
    bob.answer(bob.get(), soups="3", late="no")
    bob.get()
    platform.wait(seconds=61 * 60)
    assert heading(alice.get()) == "Thank you"
    assert soup.stored("alice", "end")["end"] == "late"
    bob.get()
    assert soup.stored("bob", "end") is None, "the game goes on"
    soup.play("bob", "game")
    assert heading(bob.get()) == "Thanks", "whoever has come to the last step has finished"


def test_time_does_not_run_out_in_a_game_that_is_the_first_step(tmp_path: Path, platform: FakePlatform) -> None:
    config = SOUP.replace("    - consent\n    - quiz: {right: {soups: 3, late: no}, tries: 2}\n", "").replace(
        '    declined: answers.consent.agree == "no"\n'
        '    screenedOut: {when: not answers.quiz.passed, code: CS1, link: "https://example.org/back"}\n',
        "",
    )
    soup = study(config, tmp_path, platform)
    alice = soup.visitor("alice")
    alice.get()
    platform.wait(seconds=61 * 60)
    alice.get()
    assert soup.stored("alice", "end") is None


# Conditions


def through_soup(soup: DesignedStudy, user: str) -> Any:
    person = soup.visitor(user)
    person.answer(person.get(), agree="yes")
    person.answer(person.get(), soups="3", late="no")
    person.get()
    return soup.stored(user, "assignment")


def test_cells_fill_evenly_whatever_the_ids(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    cells = Counter(tuple(through_soup(soup, f"P{number}")["condition"].values()) for number in range(42))
    assert len(cells) == 4
    assert max(cells.values()) - min(cells.values()) <= 1


def test_an_assignment_says_what_the_game_has_for_itself(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    seen = [through_soup(soup, f"P{number}") for number in range(8)]
    for assignment in seen:
        condition, game = assignment["condition"], assignment["games"]["game"]
        trial = {**soup.project.trial, **game.get("trial", {})}
        assert trial["players"] == {"human": "human", "partner": f"policies/{condition['partner']}.onnx"}
        assert trial["options"] == {"advice": condition["advice"], "fixed": 1}


def test_who_has_left_for_an_hour_is_not_counted(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    for number in range(8):
        through_soup(soup, f"gone{number}")
    finished = through_soup(soup, "done")["condition"]
    soup.play("done", "game")
    soup.visitor("done").get()
    platform.wait(seconds=2 * 3600)
    cells = [through_soup(soup, f"P{number}")["condition"] for number in range(7)]
    counted = Counter(json.dumps(cell) for cell in [*cells, finished])
    assert set(counted.values()) == {2}, "the one who finished counts, the eight who left do not"


def test_a_repeated_assignment_is_the_same(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    first = through_soup(soup, "alice")
    del platform.documents.kept["soup/users/alice/assignment.json"]
    soup.visitor("alice").get()
    assert soup.stored("alice", "assignment") == first
    assert sum(json.loads(platform.documents.kept["_cells/soup.json"][0])["people"].values()) == 1


def test_those_who_left_are_looked_up_once_however_often_others_write_first(
    tmp_path: Path, platform: FakePlatform, monkeypatch: pytest.MonkeyPatch
) -> None:
    soup = study(SOUP, tmp_path, platform)
    for number in range(5):
        through_soup(soup, f"gone{number}")
    platform.wait(seconds=2 * 3600)
    documents, conflicts, looked = platform.documents, iter(range(3)), Counter[str]()
    replace, listing = documents.replace, documents.list

    def busy(key: str, body: bytes, etag: str) -> str:
        if key.startswith("_cells/") and next(conflicts, None) is not None:
            raise Conflict
        return replace(key, body, etag)

    def counted(prefix: str) -> Any:
        looked[prefix] += 1
        return listing(prefix)

    monkeypatch.setattr(documents, "replace", busy)
    monkeypatch.setattr(documents, "list", counted)
    through_soup(soup, "alice")
    assert {looked[f"soup/users/gone{number}/"] for number in range(5)} == {1}
    assert sum(json.loads(documents.kept["_cells/soup.json"][0])["people"].values()) == 1


LAST = """
project:
  id: last
  conditions: {partner: [helpful, lazy]}
  steps: [consent, rate, {debrief: {page: "debrief-{partner}"}}]
  ends: {quota: 'answers.consent.agree == "no" and condition.partner != "none"'}
"""
LAST_PAGES = {f"debrief-{name}": f"<h1>Thanks, {name}</h1>" for name in ("helpful", "lazy")}


def last(tmp_path: Path, platform: FakePlatform) -> DesignedStudy:
    pages = {**PAGES, **LAST_PAGES, "rate": "<h1>Rate</h1><input name='q1'><button>Go on</button>"}
    return DesignedStudy(write(tmp_path / "last", LAST, pages), platform)


def test_the_last_page_may_be_the_first_that_names_a_factor(tmp_path: Path, platform: FakePlatform) -> None:
    study = last(tmp_path, platform)
    alice = study.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    alice.answer(alice.get(), q1="1")
    assert heading(alice.get()) == f"Thanks, {study.stored('alice', 'assignment')['condition']['partner']}"


def test_an_end_that_asks_for_the_condition_draws_it(tmp_path: Path, platform: FakePlatform) -> None:
    study = last(tmp_path, platform)
    alice = study.visitor("alice")
    alice.answer(alice.get(), agree="no")
    assert heading(alice.get()) == "Thank you"
    assert study.stored("alice", "end")["end"] == "quota"
    assert study.stored("alice", "assignment")["condition"]["partner"] in ("helpful", "lazy")


def test_a_page_shuffles_a_list_in_an_order_of_each_persons_own(tmp_path: Path, platform: FakePlatform) -> None:
    page = (
        "{% set left = shuffle(['a', 'b', 'c', 'd']) %}<p>{{ left | join }} {{ shuffle(['a', 'b', 'c', 'd']) | join }}</p>"
        "<input type='hidden' name='order' value='{{ left | join }}'><button>Go on</button>"
    )
    config = "project:\n  id: lists\n  steps: [consent, debrief]\n"
    study = DesignedStudy(write(tmp_path / "lists", config, {"consent": page, "debrief": "<h1>Thanks</h1>"}), platform)
    seen = set()
    for number in range(20):
        visitor = study.visitor(f"p{number}")
        orders = re.search(r"<p>(\w{4}) (\w{4})</p>", visitor.get())
        assert orders
        assert orders[0] in visitor.get(), "the same each time"
        seen.add(orders.groups())
    assert len(seen) > 10
    assert any(first != second for first, second in seen), "each list of a page has an order of its own"


@pytest.mark.parametrize("on_aws", [True, False])
def test_other_factors_are_refused_on_aws_once_people_are_assigned(
    tmp_path: Path, platform: FakePlatform, on_aws: bool
) -> None:
    study = last(tmp_path, platform)
    three = write(tmp_path / "three", LAST.replace("lazy]", "lazy, mean]"), {**PAGES, **LAST_PAGES, "debrief-mean": ""})
    place = {"useAWS": on_aws, "awsSetup": {"cpu": 1, "memory": 2}}
    before, after = study.config.registration() | place, read_project(three).registration() | place
    platform.documents.put(step_key("last", "debrief-mean"), b"<h1>Thanks</h1>")
    registry.register(platform, after)  # nobody was assigned yet
    registry.register(platform, before)
    alice = study.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    alice.answer(alice.get(), q1="1")
    alice.get()
    registry.register(platform, {**before, "name": "Another name"})
    if on_aws:
        with pytest.raises(registry.NotRegistered, match="1 people were assigned to levels and orders"):
            registry.register(platform, after)
    else:
        registry.register(platform, after)


def test_who_was_erased_and_comes_again_is_on_the_path_of_the_new_assignment(
    tmp_path: Path, platform: FakePlatform
) -> None:
    study = last(tmp_path, platform)
    seen = set()
    for _ in range(12):
        alice = study.visitor("alice")
        alice.answer(alice.get(), agree="yes")
        alice.answer(alice.get(), q1="1")
        assert heading(alice.get()) == heading(alice.get())
        seen.add(heading(alice.get()))
        platform.wait(seconds=60)
        for key in [key for key in platform.documents.kept if key.startswith(("last/users", "_cells"))]:
            platform.documents.delete(key)
    assert seen == {"Thanks, helpful", "Thanks, lazy"}


# Blocks


def through_looks(looks: DesignedStudy, user: str) -> list[str]:
    """Take part up to the end; return the levels in the order in which they came."""
    person, order = looks.visitor(user), []
    person.answer(person.get(), agree="yes")
    for position in range(1, 4):
        assert "queued" in person.get() or position
        (due,) = [key for key in looks.stored(user, "assignment")["games"] if key not in looks.answers(user)][:1]
        looks.play(user, due, score=position)
        page = person.get()
        found = re.search(r"look (\w+) run (\d)", page)
        assert found
        assert (f"game-{found[1]}", found[2]) == (due, str(position))
        order.append(found[1])
        person.answer(page, q1=str(position))
    assert ",".join(order) in person.get()
    return order


def test_each_level_comes_once_and_the_orders_are_those_of_a_williams_square(
    tmp_path: Path, platform: FakePlatform
) -> None:
    looks = study(LOOKS, tmp_path, platform)
    orders = [through_looks(looks, f"P{number}") for number in range(6)]
    levels = ["plain", "face", "voice"]
    assert sorted(orders) == sorted([levels[place] for place in row] for row in latin_rows(3))
    answers = looks.answers("P0")
    assert set(answers) == {"consent", *(f"{step}-{level}" for step in ("game", "rate") for level in levels)}
    games = looks.stored("P0", "assignment")["games"]
    for level in levels:
        assert games[f"game-{level}"]["trial"]["maxEpisodes"] == 2
        assert {**looks.project.trial, **games[f"game-{level}"]["trial"]}["options"] == {"look": level}
    assert list(games) == [f"game-{level}" for level in orders[0]]


@pytest.mark.parametrize("order", ["random", "fixed"])
def test_the_other_orders(tmp_path: Path, platform: FakePlatform, order: str) -> None:
    looks = study(LOOKS.replace("steps: [game:", f"order: {order}\n      steps: [game:"), tmp_path, platform)
    orders = {tuple(through_looks(looks, f"P{number}")) for number in range(8)}
    assert (len(orders) > 1) == (order == "random")
    assert order == "random" or orders == {("plain", "face", "voice")}


def test_pages_alone_are_repeated_in_balanced_orders_too(tmp_path: Path, platform: FakePlatform) -> None:
    steps = "[consent, {each: {look: [plain, face, voice]}, steps: [rate]}, debrief]"
    looks = study(f"project: {{id: looks, steps: {steps}}}\n", tmp_path, platform)
    orders = []
    for number in range(6):
        person = looks.visitor(f"P{number}")
        person.answer(person.get(), agree="yes")
        for _ in range(3):
            person.answer(person.get(), q1="1")
        found = re.search(r"[a-z]+,[a-z]+,[a-z]+", person.get().partition("</h1>")[2])
        assert found
        orders.append(found[0].split(","))
    levels = ["plain", "face", "voice"]
    assert sorted(orders) == sorted([levels[place] for place in row] for row in latin_rows(3))


def test_only_some_runs_are_taken(tmp_path: Path, platform: FakePlatform) -> None:
    looks = study(LOOKS.replace("steps: [game:", "take: 2\n      steps: [game:"), tmp_path, platform)
    alice = looks.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    alice.get()
    assert len(looks.stored("alice", "assignment")["games"]) == 2


def test_a_server_starts_at_the_first_run_and_stops_after_the_last(tmp_path: Path, platform: FakePlatform) -> None:
    looks = study(LOOKS, tmp_path, platform)
    through_looks(looks, "alice")
    looks.visitor("alice").get()
    kinds = [kind for place, kind in enumerate(topics(platform)) if place == 0 or topics(platform)[place - 1] != kind]
    assert kinds == [Topic.START, Topic.STOP]


def test_the_page_of_an_end_is_no_step(tmp_path: Path, platform: FakePlatform) -> None:
    config = 'project:\n  id: leave\n  steps: [consent, debrief]\n  ends:\n    declined: {when: answers.consent.agree == "no", page: rate}\n'
    alice = study(config, tmp_path, platform).visitor("alice")
    assert "Step 1 of 2" in alice.get()
    alice.answer(alice.get(), agree="no")
    page = alice.get()
    assert (heading(page), "Step 1" in page) == ("Rate", False)


# Steps that are skipped


def test_a_step_is_skipped_unless_its_rule_holds(tmp_path: Path, platform: FakePlatform) -> None:
    config = 'project:\n  id: skips\n  steps:\n    - consent\n    - rate: {when: answers.consent.agree == "yes"}\n    - debrief\n'
    skips = study(config, tmp_path, platform)
    alice, bob = skips.visitor("alice"), skips.visitor("bob")
    for person, answer in ((alice, "yes"), (bob, "no")):
        person.answer(person.get(), agree=answer)
    assert (heading(alice.get()), heading(bob.get())) == ("Rate", "Thanks")
    assert skips.answers("bob")["rate"] == {"outcome": "skipped"}


def test_a_page_has_a_least_and_a_longest_time(tmp_path: Path, platform: FakePlatform) -> None:
    config = "project:\n  id: times\n  steps:\n    - consent: {minSeconds: 60}\n    - rate: {maxSeconds: 30}\n    - debrief\n"
    times = study(config, tmp_path, platform)
    alice = times.visitor("alice")
    page = alice.get()
    assert 'data-least="60"' in page  # the script of the page says how many seconds are left
    alice.answer(page, agree="yes")
    assert heading(alice.get()) == "Consent"
    platform.wait(seconds=61)
    alice.answer(page, agree="yes")
    assert heading(alice.get()) == "Rate"
    platform.wait(seconds=31)
    assert heading(alice.get()) == "Thanks"
    assert times.answers("alice")["rate"] == {"outcome": "timeOver"}


def test_two_sittings_a_day_apart_have_a_server_each(tmp_path: Path, platform: FakePlatform) -> None:
    pages = PAGES | {"tomorrow": "<h1>Until tomorrow</h1><button>Go on</button>"}
    days = DesignedStudy(write(tmp_path / "study", SITTINGS, pages), platform)
    alice = days.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    alice.get()
    first = started(days, "alice", 1)
    days.play("alice", "game")
    page = alice.get()
    assert 'data-least="86400"' in page
    platform.wait(minutes=11)
    days.platform.documents.put(server.key(first.label), to_json(server.close(first, Reason.ENDED, platform.now())))
    alice.answer(page)
    assert 'data-least="85740"' in alice.get(), "the time runs while the page is closed"
    platform.wait(hours=24)
    page = alice.get()
    assert "data-least" not in page
    alice.answer(page)
    before = len(platform.bus.sent)
    game = json.loads(alice.send(accept="application/json")["body"])
    (sent,) = platform.bus.sent[before:]
    assert (sent[0], sent[1]["attempt"]) == (Topic.START, 2)
    assert (game["state"], game["attempt"], game["step"]) == ("queued", 2, "game2")
    alice.query += "&poll=game2&attempt=2"
    assert json.loads(alice.get(accept="application/json"))["state"] == "queued", "its record is not there yet"
    started(days, "alice", 2, first)
    assert json.loads(alice.get(accept="application/json"))["state"] == "starting"


def test_who_waits_for_the_second_sitting_still_counts_in_their_cell(tmp_path: Path, platform: FakePlatform) -> None:
    pages = PAGES | {"tomorrow": "<button>Go on</button>"}
    config = SITTINGS.replace("  steps:", "  conditions: {pay: [low, high]}\n  steps:", 1)
    days = DesignedStudy(write(tmp_path / "study", config, pages), platform)
    for number in range(20):
        person = days.visitor(f"P{number}")
        person.answer(person.get(), agree="yes")
        person.get()
        platform.wait(hours=1)
    conditions = Counter(days.stored(f"P{number}", "assignment")["condition"]["pay"] for number in range(20))
    assert conditions == {"low": 10, "high": 10}
    cells = json.loads(platform.documents.kept["_cells/days.json"][0])
    assert cells["people"] == {"low": 10, "high": 10}


def test_time_runs_out_between_the_tries_of_a_check_too(tmp_path: Path, platform: FakePlatform) -> None:
    config = "project:\n  id: times\n  steps:\n    - quiz: {right: {soups: 3}, maxSeconds: 30}\n    - debrief\n"
    times = study(config, tmp_path, platform)
    alice = times.visitor("alice")
    alice.answer(alice.get(), soups="2")
    assert "One answer is not correct yet." in alice.get()
    platform.wait(seconds=31)
    assert heading(alice.get()) == "Thanks"
    assert times.answers("alice")["quiz"] == {"soups": "2", "passed": False, "tries": 1, "outcome": "timeOver"}


# Everybody


def test_four_hundred_random_participants_reach_an_end(tmp_path: Path, platform: FakePlatform) -> None:
    soup = study(SOUP, tmp_path, platform)
    ends: Counter[str] = Counter()
    for number in range(400):
        random, user = Random(number), f"R{number}"
        person = soup.visitor(user)
        for _ in range(20):
            page = person.get()
            if soup.stored(user, "end") or "Thanks" in page:
                break
            step = _due(person, page)
            if step == "game":
                soup.play(user, "game", score=random.randrange(9))
            else:
                person.answer(page, agree=random.choice(["yes"] * 9 + ["no"]), soups=random.choice("33x"), late="no")
            platform.wait(seconds=random.randrange(600))
        else:
            pytest.fail(f"{user} is stuck")
        ends[(soup.stored(user, "end") or {"end": "complete"})["end"]] += 1
    assert ends.keys() == {"complete", "declined", "screenedOut"}


def _due(person: Browser, page: str) -> str:
    found = re.search(r'data-step="(\w+)"', page)
    assert found
    return found[1]


# Several players

PAIRS = """
project:
  id: pairs
  players: 2
  patience: 60
  conditions: {pay: [equal, best]}
  steps:
    - consent
    - each: {look: [plain, face, voice]}
      steps: [game: {options: {look: "{look}", pay: "{pay}"}}, rate]
    - about: {page: "about-{pay}"}
    - debrief
trial:
  game: kitchen
  players: {a: human, b: human}
"""
ABOUT = {f"about-{pay}": f"<h1>About {pay}</h1><button>Go on</button>" for pay in ("equal", "best")}


def pairs(tmp_path: Path, platform: FakePlatform) -> DesignedStudy:
    return DesignedStudy(write(tmp_path / "pairs", PAIRS, {**PAGES, **ABOUT}), platform)


def consented(pair: DesignedStudy, user: str) -> Browser:
    visitor = pair.visitor(user)
    visitor.answer(visitor.get(), agree="yes")
    return visitor


def polled(page: str, browser: Browser) -> dict[str, Any]:
    """What the lobby's page is told when it asks."""
    address = re.search(r'"poll": ?"[^"?]*\?([^"]+)"', page)
    assert address, page
    response = Browser(browser.platform, html.unescape(address[1]).replace("\\u0026", "&")).send()
    assert response["statusCode"] == 200, response
    return dict(json.loads(response["body"]))


def matched(pair: DesignedStudy, *users: str) -> tuple[str, str]:
    """Two participants who wait in the lobby at once, and their pages after they were matched."""
    first, second = (consented(pair, user) for user in users)
    lobby = first.get()
    second.get()
    for _ in range(4):
        pair.platform.wait(seconds=2)
        first_told, second_told = polled(lobby, first), second.get()
    assert first_told["state"] == "ended", "the page that waited is loaded again"
    return first.get(), second_told


def test_participants_who_play_together_are_assigned_together(tmp_path: Path, platform: FakePlatform) -> None:
    pair = pairs(tmp_path, platform)
    matched(pair, "ann", "ben")
    theirs = [pair.stored(user, "assignment") for user in ("ann", "ben")]
    session = pair.stored("ann", "session")["session"]
    ours = json.loads(platform.documents.kept[f"pairs/sessions/{session}/assignment.json"][0])
    assert theirs == [ours, ours], "one path for both"
    assert list(ours["games"]) == [f"game-{look}" for (look,) in ours["orders"]["look"]]
    matched(pair, "cid", "dan")
    conditions = {pair.stored(user, "assignment")["condition"]["pay"] for user in ("ann", "cid")}
    assert conditions == {"equal", "best"}, "pairs are balanced"


def test_a_front_end_is_told_that_levels_are_drawn_with_the_match(tmp_path: Path, platform: FakePlatform) -> None:
    pair = pairs(tmp_path, platform)
    matched(pair, "cid", "dan")
    assert "unassigned" not in json.loads(pair.visitor("cid").get(accept="application/json"))
    assert json.loads(consented(pair, "ann").get(accept="application/json"))["unassigned"] is True


def test_a_lobbys_page_that_was_made_before_the_study_had_factors_is_loaded_again(
    tmp_path: Path, platform: FakePlatform
) -> None:
    pair = pairs(tmp_path, platform)
    first, second = consented(pair, "ann"), consented(pair, "ben")
    lobby = first.get().replace("unassigned=1", "")
    second.get()
    for _ in range(4):
        pair.platform.wait(seconds=2)
        told = polled(lobby, first)
        second.get()
    assert told["state"] == "ended"


def test_a_pair_goes_through_its_games_in_one_order(tmp_path: Path, platform: FakePlatform) -> None:
    pair = pairs(tmp_path, platform)
    matched(pair, "ann", "ben")
    path = list(pair.stored("ann", "assignment")["games"])
    for user in ("ann", "ben"):
        visitor = pair.visitor(user)
        for game in path:
            assert f'"{game}"' in visitor.get()
            pair.play(user, game)
            visitor.answer(visitor.get(), q1=game)
        assert heading(visitor.get()) == f"About {pair.stored(user, 'assignment')['condition']['pay']}"


def test_who_is_matched_with_nobody_has_no_condition_and_no_further_game(
    tmp_path: Path, platform: FakePlatform
) -> None:
    pair = pairs(tmp_path, platform)
    ann = consented(pair, "ann")
    ann.get()
    for _ in range(40):
        platform.wait(seconds=2)
        page = ann.get()
    assert heading(page) == "Thanks"
    assert "condition" not in pair.stored("ann", "assignment")
    assert pair.answers("ann")["about"] == {"outcome": "skipped"}


# Games that fail, and training


FAILING = LOOKS.replace(
    "trial:", "  ends:\n    failed: {code: CF1}\n    untrained: not answers.level.reached\ntrial:"
).replace("    - consent\n", "    - consent\n    - level: {until: {success: 1}, maxEpisodes: 3}\n")


def test_a_game_that_no_server_could_run_leads_to_the_end_failed(tmp_path: Path, platform: FakePlatform) -> None:
    looks = study(FAILING, tmp_path, platform)
    ann = consented(looks, "ann")
    ann.get()
    looks.play("ann", "level", reached=True)
    ann.get()
    first = next(iter(looks.stored("ann", "assignment")["orders"]["look"]))[0]
    looks.play("ann", f"game-{first}", outcome="failed")
    assert "CF1" in ann.get()
    assert looks.stored("ann", "end")["end"] == "failed"


@pytest.mark.parametrize(("reached", "end"), [(False, "untrained"), (True, None)])
def test_who_is_not_trained_leaves(tmp_path: Path, platform: FakePlatform, reached: bool, end: str | None) -> None:
    looks = study(FAILING, tmp_path, platform)
    ann = consented(looks, "ann")
    ann.get()
    looks.play("ann", "level", reached=reached)
    ann.get()
    assert (looks.stored("ann", "end") or {}).get("end") == end


# What agents read

ASKS = """
project:
  id: looks
  steps:
    - consent
    - practice: {maxEpisodes: 1}
    - each: {look: [a, b]}
      order: fixed
      steps: [ask, game: {answers: [ask, rate]}, rate]
    - again: {answers: [ask, rate]}
    - debrief
trial: {game: kitchen, answers: [consent]}
"""


def test_games_have_the_answers_that_they_name_as_rules_and_pages_see_them(
    tmp_path: Path, platform: FakePlatform
) -> None:
    looks = DesignedStudy(write(tmp_path / "study", ASKS, PAGES | {"ask": "<input name='q'>"}), platform)
    alice = looks.visitor("alice")
    alice.answer(alice.get(), agree="yes")
    alice.get()
    games = looks.stored("alice", "assignment")["games"]
    assert {key: game["answers"] for key, game in games.items()} == {
        "practice": {"consent": ["consent"]},
        "game-a": {"ask-a": ["ask"]},
        "game-b": {"ask-b": ["ask"], "rate-a": ["rate", "a"]},
        "again": {f"{step}-{level}": [step, level] for step in ("ask", "rate") for level in ("a", "b")},
    }
    assert set(looks.project.read_steps) == {"consent", "ask-a", "ask-b", "rate-a", "rate-b"}
