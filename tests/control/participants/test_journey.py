"""What a participant's requests do: next_step is called through its handler, on a platform in memory."""

from __future__ import annotations

import base64
import gzip
import io
import json
import re
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from hippodrome.control.model import ids, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import StartServer, StopServer, TaskChanged
from hippodrome.control.model.project import MASTER_LIST, Events, MasterList, step_key
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import MAX_ATTEMPTS, Reason
from hippodrome.control.ports import Refused, Topic
from hippodrome.control.storage.repository import Repository
from hippodrome.functions import installed as place
from hippodrome.functions import next_step
from testing.aws_events import FORM, http_event
from testing.exploration import examples
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import SECRET, installed, study
from testing.visitors import Browser, hidden


@pytest.fixture
def alice(platform: FakePlatform) -> Browser:
    return Browser(platform)


def stored(platform: FakePlatform, name: str, user: str = "alice") -> Any:
    found = platform.documents.kept.get(f"maze/users/{user}/{name}")
    return json.loads(found[0]) if found else None


def to_game(alice: Browser) -> None:
    alice.answer(alice.get(), consent="yes")
    alice.answer(alice.get(), age="33")


def serve(platform: FakePlatform) -> None:
    """Start the server of the start message, up to ready."""
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    (task,) = platform.tasks.running
    name = platform.tasks.running[task].name
    servers.tasks_changed([TaskChanged(task, "hippodrome", name, "RUNNING", "eni-1", None, "", None)])


def play(platform: FakePlatform) -> None:
    """Store the answer that the trial stores when the game is over."""
    platform.documents.put("maze/users/alice/answers/3.json", b'{"step": "3", "answers": {"score": 120}}')


# The way through


def test_a_participant_goes_from_the_link_to_the_completion_code(platform: FakePlatform, alice: Browser) -> None:
    assert re.search(r"Do you agree\?|May we\?", alice.get())
    assert alice.answer(alice.get(), consent="yes")["statusCode"] == 303
    assert "Age" in alice.get()
    alice.answer(alice.get(), age="33", pet=["cat", "dog"])
    assert "queued" in alice.get()
    serve(platform)
    assert "wss://" in alice.get()
    play(platform)
    assert "words" in alice.get()
    alice.answer(alice.get(), words="It was\nfun ☃")
    code = stored(platform, "participant.json")["completionCode"]
    assert code in alice.get()
    assert stored(platform, "answers/1.json")["answers"] == {"consent": "yes"}
    assert stored(platform, "answers/2.json")["answers"] == {"age": "33", "pet": ["cat", "dog"]}
    assert stored(platform, "answers/4.json")["answers"] == {"words": "It was\nfun ☃"}


def test_a_participants_documents_have_a_line_for_each_field(platform: FakePlatform, alice: Browser) -> None:
    alice.answer(alice.get(), consent="yes")
    for name in ("participant.json", "answers/1.json"):
        lines = platform.documents.kept[f"maze/users/alice/{name}"][0].decode().splitlines()
        named = [re.match(r'( +)"(\w+)": ', line) for line in lines]
        assert [found[2] for found in named if found and found[1] == " "] == list(stored(platform, name))


def test_a_get_never_moves_a_participant_on(platform: FakePlatform, alice: Browser) -> None:
    first = alice.get()
    before = dict(platform.documents.kept)
    for _ in range(5):
        assert re.sub(r'nonce[-="\w]+', "", alice.get()) == re.sub(r'nonce[-="\w]+', "", first)
    assert platform.documents.kept == before


def test_the_same_link_resumes_in_any_browser(platform: FakePlatform, alice: Browser) -> None:
    alice.answer(alice.get(), consent="yes")
    assert "Age" in Browser(platform).get()


def test_a_post_redirects_to_the_whole_link(platform: FakePlatform) -> None:
    browser = Browser(platform, "projectId=maze&PROLIFIC_PID=abc&STUDY_ID=s%26t")
    response = browser.answer(browser.get(), consent="yes")
    assert response["headers"]["Location"] == "/next?projectId=maze&PROLIFIC_PID=abc&STUDY_ID=s%26t"
    assert stored(platform, "participant.json", "abc")["link"] == {"PROLIFIC_PID": "abc", "STUDY_ID": "s&t"}


def test_a_link_without_an_id_gets_one_and_keeps_it(platform: FakePlatform) -> None:
    response = Browser(platform, "projectId=maze").send()
    assert response["statusCode"] == 302
    query = response["headers"]["Location"].partition("?")[2]
    assert re.fullmatch(r"projectId=maze&userId=[0-9a-f]{24}", query)
    assert not any("users" in key for key in platform.documents.kept)
    Browser(platform, query).get()


@pytest.mark.parametrize("name", ["PROLIFIC_PID", "workerId", "survey_code", "participantId"])
def test_the_recruiters_id_is_the_participants_id(platform: FakePlatform, name: str) -> None:
    Browser(platform, f"projectId=maze&{name}=R2D2").get()
    assert stored(platform, "participant.json", "R2D2")


@pytest.mark.parametrize(
    "query",
    [
        "projectId=maze&prolific_pid=R2D2",
        "projectId=maze&ProlificPid=R2D2",
        "projectId=maze&amp;PROLIFIC_PID=R2D2",
        "projectId=maze&amp;amp;prolific-pid=R2D2",
        "projectId=maze&workerid=R2D2",
        "projectId=maze&worker_id=R2D2",
        "projectId=maze&SURVEY_CODE=R2D2",
        "projectId=maze&surveyCode=R2D2",
        "projectId=maze&participant_id=R2D2",
        "projectId=maze&user_id=R2D2",
        "projectID=maze&amp;USERID=R2D2",
        "amp;project_id=maze&userid=R2D2",
        "projectId=maze&project_id=other&userId=R2D2",
        "projectId=maze&PROLIFIC_PID=R2D2&user_id=C3PO",
        "projectId=maze&user_id=C3PO&userId=R2D2",
    ],
)
def test_another_spelling_of_an_id_is_the_same_participant(platform: FakePlatform, query: str) -> None:
    """The right spelling wins: a field that is only similar may be the recruiter's own."""
    browser = Browser(platform, query)
    browser.answer(browser.get(), consent="yes")
    assert stored(platform, "answers/1.json", "R2D2")


def test_a_link_copied_from_html_and_in_other_spellings_has_the_same_fields(platform: FakePlatform) -> None:
    Browser(platform, "projectid=maze&amp;prolific_pid=R2D2&amp;STUDY_ID=7&amp;group=a").get()
    assert stored(platform, "participant.json", "R2D2")["link"] == {
        "PROLIFIC_PID": "R2D2",
        "STUDY_ID": "7",
        "group": "a",
    }


def test_an_id_given_twice_with_two_values_is_refused_in_every_spelling(platform: FakePlatform) -> None:
    assert Browser(platform, "projectId=maze&userid=a&USERID=b").send()["statusCode"] == 400


# Nothing is lost, nothing is overwritten


def test_a_second_submit_of_an_old_page_changes_nothing(platform: FakePlatform, alice: Browser) -> None:
    page = alice.get()
    alice.answer(page, consent="yes")
    first = stored(platform, "answers/1.json")
    assert alice.answer(page, consent="no")["statusCode"] == 303
    assert stored(platform, "answers/1.json") == first
    assert "Age" in alice.get()


def test_two_submits_at_the_same_moment_keep_the_first(platform: FakePlatform, alice: Browser) -> None:
    page = alice.get()
    platform.documents.before_write.append(lambda: alice.answer(page, consent="first"))
    alice.answer(page, consent="second")
    assert stored(platform, "answers/1.json")["answers"] == {"consent": "first"}


@pytest.mark.parametrize("fields", [
    {"hippodrome-step": "2", "age": "1"},
    {"hippodrome-step": "4", "words": "x"},
    {"hippodrome-step": "4", "hippodrome-ticket": "0" * 32, "words": "x"},
    {"hippodrome-step": "99"},
    {"hippodrome-step": "../1"},
    {"hippodrome-step": "finalStep", "x": "1"},
])  # fmt: skip
def test_a_post_for_a_step_not_yet_reached_changes_nothing(
    platform: FakePlatform, alice: Browser, fields: dict[str, str]
) -> None:
    alice.get()
    before = dict(platform.documents.kept)
    assert alice.post(**fields)["statusCode"] == 303
    assert platform.documents.kept == before


def test_the_ticket_of_another_participant_does_not_count(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    bob = Browser(platform, "projectId=maze&userId=bob")
    bob.get()
    bob.post(**{"hippodrome-step": "2", "hippodrome-ticket": ids.ticket(SECRET, "alice", "2"), "age": "1"})
    assert stored(platform, "answers/2.json", "bob") is None


def test_only_the_trial_answers_the_game_step(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    page = alice.get()
    alice.answer(page, score="99999")
    assert stored(platform, "answers/3.json") is None


def test_a_post_before_the_first_visit_changes_nothing(platform: FakePlatform, alice: Browser) -> None:
    before = dict(platform.documents.kept)
    assert alice.post(consent="yes")["statusCode"] == 303
    assert platform.documents.kept == before


def test_a_final_step_with_questions_is_answered_once() -> None:
    platform = installed()
    platform.documents.put(step_key("maze", "debrief"), b"<input name='mail'>")
    alice = Browser(platform)
    alice.get()
    for key in "1234":
        platform.documents.put(f"maze/users/alice/answers/{key}.json", b"{}")
    page = alice.get()
    alice.answer(page, mail="a@example.org")
    assert stored(platform, "answers/finalStep.json")["answers"] == {"mail": "a@example.org"}
    assert "hippodrome-step" not in alice.get()  # the page has no form any more


# Servers


def sent(platform: FakePlatform) -> list[tuple[str, str]]:
    return [(str(topic), str(message["userId"])) for topic, message in platform.bus.sent]


def test_reaching_the_event_steps_starts_and_stops_the_server(platform: FakePlatform, alice: Browser) -> None:
    page = alice.get()
    assert sent(platform) == []
    alice.answer(page, consent="yes")
    assert sent(platform) == [], "whoever closes the tab now needs no server"
    page = alice.get()
    assert sent(platform) == [(Topic.START, "alice")]
    alice.answer(page, age="1")
    alice.get()
    assert sent(platform) == [(Topic.START, "alice")]
    play(platform)
    alice.get()
    assert sent(platform) == [(Topic.START, "alice"), (Topic.STOP, "alice")]


def test_a_study_may_start_its_server_at_the_link() -> None:
    platform = installed(study(events=Events("1", "4")))
    alice = Browser(platform)
    alice.get()
    assert sent(platform) == [(Topic.START, "alice")]


def test_a_lost_start_message_is_sent_again(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    alice.get()
    assert len(sent(platform)) == 1
    platform.wait(seconds=31)
    alice.get()
    assert sent(platform) == [(Topic.START, "alice")] * 2


def test_a_page_asks_again_for_the_replacement_of_a_lost_server(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    serve(platform)
    platform.tasks.running.clear()
    stored_server = Repository(platform.documents).server(ids.server_label("maze", "alice"))
    assert stored_server
    Servers(platform).clean_up_lost(stored_server, server.Reason.LOST)
    platform.bus.sent.clear()  # as if the function had crashed just then, or the study had been closed for a while
    alice.get()
    assert not platform.bus.sent
    platform.wait(seconds=31)
    alice.get()
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2})]


def test_a_page_asks_again_for_a_server_that_does_not_run_after_a_while(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    Servers(platform).start(StartServer("maze", "alice"))
    platform.bus.sent.clear()
    platform.wait(minutes=2)
    alice.get()
    assert not platform.bus.sent
    platform.wait(minutes=2)
    alice.get()
    Servers(platform).start(StartServer("maze", "alice"))
    assert sent(platform) == [(Topic.START, "alice")]
    assert len(platform.tasks.running) == 1


def test_a_server_from_before_the_steps_were_renumbered_is_stopped_and_may_be_replaced(
    platform: FakePlatform, alice: Browser
) -> None:
    to_game(alice)
    serve(platform)
    first, second, *_, last = study().steps
    steps = [first, second, Step("3", "survey"), Step("4", "game"), last]
    platform.documents.put(MASTER_LIST, to_json(MasterList([study(steps=steps, events=Events("2", "finalStep"))])))
    platform.wait(minutes=1)
    alice.answer(alice.get(), words="a page that was put before the game")
    platform.bus.sent.clear()
    alice.get()
    assert platform.bus.sent == [(Topic.STOP, {"projectId": "maze", "userId": "alice", "attempt": 1})]
    state = poll(alice, "4")
    assert (state["state"], "url" in state) == ("queued", False), "no page connects to a server that would refuse it"
    assert poll(alice, "3")["state"] == "ready", "an old tab plays on"
    Servers(platform).stop([StopServer("maze", "alice", 1)])
    state = poll(alice, "4")
    assert (state["state"], state["again"]) == ("ended", True)
    platform.bus.sent.clear()
    alice.post(**hidden(alice.get()), **{"hippodrome-action": "restart"})
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2})]


def test_a_start_message_that_a_crash_has_lost_is_sent_with_the_next_load(
    platform: FakePlatform, alice: Browser
) -> None:
    alice.answer(alice.get(), consent="yes")
    publish = platform.bus.publish

    def crash(*_arguments: object) -> None:
        raise SystemExit

    platform.bus.publish = crash  # type: ignore[method-assign]
    with pytest.raises(SystemExit):
        alice.get()
    platform.bus.publish = publish  # type: ignore[method-assign]
    alice.get()
    assert sent(platform) == [(Topic.START, "alice")]


def poll(alice: Browser, step: str = "3") -> Any:
    response = Browser(alice.platform, f"{alice.query}&poll={step}").send(accept="application/json")
    assert response["statusCode"] == 200
    return json.loads(response["body"])


def test_the_waiting_page_gets_the_servers_present_state(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    assert poll(alice)["state"] == "queued"
    platform.wait(seconds=7)
    Servers(platform).start(StartServer("maze", "alice"))
    platform.wait(seconds=5)
    state = poll(alice)
    assert (state["state"], state["seconds"], state["typical"]) == ("starting", 5, None)
    assert "token" not in state
    platform.dns.slow = True
    serve(platform)
    assert poll(alice)["state"] == "naming"
    platform.dns.settle()
    from hippodrome.control.model import messages

    follow = messages.parse_dns_changed(json.loads(json.dumps(platform.bus.delayed[-1][1])))
    assert follow
    Servers(platform).dns_changed(follow)
    state = poll(alice)
    label = ids.server_label("maze", "alice")
    assert state["url"] == f"wss://{label}-1.servers.example.org:5000/"
    assert state["token"]
    assert state["typical"] == 5


def test_after_a_failed_server_the_participant_can_ask_for_another(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    platform.tasks.fail = [Refused("no")]
    Servers(platform).start(StartServer("maze", "alice"))
    assert poll(alice) | {"seconds": 0} == {
        "state": "failed", "attempt": 1, "again": True, "without": True, "reason": "refused", "userId": "alice", "step": "3",
        "seconds": 0, "typical": None, "replaces": False,
    }  # fmt: skip
    platform.bus.sent.clear()
    alice.post(**hidden(alice.get()), **{"hippodrome-action": "restart"})
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2})]


def test_nobody_gets_another_server_for_a_game_that_is_over(platform: FakePlatform, alice: Browser) -> None:
    failed(platform, alice)
    page = alice.get()
    alice.post(**hidden(page), **{"hippodrome-action": "without"})
    platform.bus.sent.clear()
    alice.post(**hidden(page), **{"hippodrome-action": "restart"})
    assert [topic for topic, _ in platform.bus.sent if topic is Topic.START] == []


def answer_of(platform: FakePlatform, step: str) -> dict[str, Any]:
    """Return alice's stored answers at this step."""
    found: dict[str, Any] = json.loads(platform.documents.kept[f"maze/users/alice/answers/{step}.json"][0])["answers"]
    return found


def failed(platform: FakePlatform, alice: Browser) -> None:
    """Let alice come to the game, for which no server can be started."""
    to_game(alice)
    platform.tasks.fail = [Refused("no")]
    Servers(platform).start(StartServer("maze", "alice"))


def test_a_participant_whose_game_failed_goes_on_without_it(platform: FakePlatform, alice: Browser) -> None:
    failed(platform, alice)
    page = alice.get()
    alice.post(**hidden(page), **{"hippodrome-action": "without"})
    code = ids.completion_code(SECRET, "alice", "failed")
    assert answer_of(platform, "3") == {
        "episodes": 0, "score": 0, "frames": 0, "seconds": 0, "outcome": "failed", "completionCode": code
    }  # fmt: skip
    assert code in page
    after = alice.get()
    assert "over-title" not in after, "the step after the game is due"


def test_the_last_page_shows_the_code_of_a_game_that_failed(platform: FakePlatform, alice: Browser) -> None:
    failed(platform, alice)
    platform.documents.put("maze/steps/bye.html", b"<p>code: {{ completion_code }}</p>")
    alice.post(**hidden(alice.get()), **{"hippodrome-action": "without"})
    for _ in range(3):
        page = alice.get()
        if "code: " in page:
            break
        alice.answer(page)
    assert f"code: {ids.completion_code(SECRET, 'alice', 'failed')}" in page


def test_the_answer_that_the_trial_has_stored_stays(platform: FakePlatform, alice: Browser) -> None:
    failed(platform, alice)
    page = alice.get()
    played = json.dumps({"answers": {"score": 7, "outcome": "finished"}}).encode()
    platform.documents.before_write.append(lambda: platform.documents.put("maze/users/alice/answers/3.json", played))
    alice.post(**hidden(page), **{"hippodrome-action": "without"})
    assert answer_of(platform, "3") == {"score": 7, "outcome": "finished"}


def test_nobody_goes_on_without_a_game_that_another_server_runs(platform: FakePlatform, alice: Browser) -> None:
    """The participant has asked for another server in a second tab, and the first still shows the old page."""
    failed(platform, alice)
    page = alice.get()
    Servers(platform).start(StartServer("maze", "alice", 2))
    alice.post(**hidden(page), **{"hippodrome-action": "without"})
    assert "maze/users/alice/answers/3.json" not in platform.documents.kept
    assert poll(alice)["state"] == "starting"


def test_a_participant_whose_server_was_lost_sees_that_another_replaces_it(
    platform: FakePlatform, alice: Browser
) -> None:
    to_game(alice)
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    assert not poll(alice)["replaces"]
    (task, request), *_ = platform.tasks.running.items()
    servers.tasks_changed(
        [TaskChanged(task, "hippodrome", request.name, "DEPROVISIONING", None, "SpotInterruption", "", None)]
    )
    assert (poll(alice)["state"], poll(alice)["attempt"], poll(alice)["replaces"]) == ("queued", 2, True)
    servers.start(StartServer("maze", "alice", 2))
    assert (poll(alice)["state"], poll(alice)["replaces"]) == ("starting", True)
    assert '<div id="wait-moved">' in alice.get()


def program(alice: Browser, form: dict[str, str] | None = None) -> dict[str, Any]:
    """Return the answer that HIPPO's front end gets; with `form`, after a click on its button."""
    sent, method = (None, "GET") if form is None else (json.dumps(form), "POST")
    response = alice.send(method, sent, accept="application/json, text/plain, */*", content_type="application/json")
    found: dict[str, Any] = json.loads(response["body"])
    return found


def test_a_program_whose_game_was_lost_gets_a_page_whose_button_makes_it_poll(
    platform: FakePlatform, alice: Browser
) -> None:
    """HIPPO's front end asks once when its connection ends. It polls only after a form that is answered with `wait`."""
    to_game(alice)
    serve(platform)
    assert program(alice)["page"] == "show_game_page"
    (task, request), *_ = platform.tasks.running.items()
    servers = Servers(platform)
    servers.tasks_changed(
        [TaskChanged(task, "hippodrome", request.name, "DEPROVISIONING", None, "SpotInterruption", "", None)]
    )
    answer = program(alice)
    assert "The connection to your game was lost" in answer["page"]
    assert answer["state"] == "queued"
    assert program(alice, hidden(answer["page"]))["page"] == "wait"
    servers.start(StartServer("maze", "alice", 2))
    assert "The connection to your game was lost" in program(alice)["page"]


def test_a_program_whose_game_is_over_gets_a_page_that_asks_for_another_server(
    platform: FakePlatform, alice: Browser
) -> None:
    to_game(alice)
    platform.tasks.fail = [Refused("no")]
    Servers(platform).start(StartServer("maze", "alice"))
    page = program(alice)["page"]
    assert "The game could not start" in page
    assert "Press the button below to continue." in page
    platform.bus.sent.clear()
    assert program(alice, hidden(page))["page"] == "wait"
    assert platform.bus.sent == [(Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2})]


def test_a_program_that_gets_no_more_servers_gets_a_page_that_says_so(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    last = server.stopped_before_start("maze", "alice", MAX_ATTEMPTS, platform.now())
    platform.documents.put(server.key(last.label), to_json(last))
    for form in (None, {}):
        page = program(alice, form)["page"]
        assert "<h1>" in page
        assert "restart" not in page


def used_up(platform: FakePlatform, *earlier: Reason) -> None:
    """Let alice have had all her servers: she stopped the last one, and the earlier ones ended for these reasons."""
    last = server.stopped_before_start("maze", "alice", MAX_ATTEMPTS, platform.now())
    past = tuple(replace(server.past_attempt(last), attempt=n, reason=reason) for n, reason in enumerate(earlier, 1))
    platform.documents.put(server.key(last.label), to_json(replace(last, earlier=past)))


def test_a_program_goes_on_without_a_game_that_failed_once_there_are_no_more_servers(
    platform: FakePlatform, alice: Browser
) -> None:
    to_game(alice)
    used_up(platform, Reason.LOST, Reason.STOPPED)
    program(alice, hidden(program(alice)["page"]))
    assert answer_of(platform, "3")["outcome"] == "failed"


def test_nobody_gets_past_the_game_by_stopping_their_own_servers(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    used_up(platform, *[Reason.STOPPED] * (MAX_ATTEMPTS - 1))
    proof = {"hippodrome-step": "3", "hippodrome-ticket": ids.ticket(SECRET, "alice", "3")}
    alice.post(**proof, **{"hippodrome-action": "without"})
    assert "maze/users/alice/answers/3.json" not in platform.documents.kept
    assert ids.completion_code(SECRET, "alice", "failed") not in alice.get()


def test_a_participant_gets_at_most_eight_servers(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    last = server.stopped_before_start("maze", "alice", MAX_ATTEMPTS, platform.now())
    platform.documents.put(server.key(last.label), to_json(last))
    platform.bus.sent.clear()
    alice.get()
    proof = {"hippodrome-step": "3", "hippodrome-ticket": ids.ticket(SECRET, "alice", "3")}
    alice.post(**proof, **{"hippodrome-action": "restart"})
    assert platform.bus.sent == []
    assert not poll(alice)["again"]


# Programs (HIPPO's front end)


def test_a_program_gets_answers_as_from_hippo(platform: FakePlatform, alice: Browser) -> None:
    def ask(method: str = "GET", body: object = None) -> Any:
        sent = json.dumps(body) if body is not None else None
        response = alice.send(method, sent, accept="application/json, text/plain, */*", content_type="application/json")
        assert response["headers"]["Access-Control-Allow-Origin"] == "*"
        return json.loads(response["body"])

    first = ask()
    assert re.search(r"Do you agree\?|May we\?", first["page"])
    assert "<form" not in first["page"]
    assert "css" in first
    assert "Age" in ask("POST", {"consent": "yes"})["page"]
    assert ask("POST", {"age": "12"})["page"] == "wait"
    assert ask()["page"] == "wait"
    serve(platform)
    assert ask()["page"] == "show_game_page"
    assert stored(platform, "answers/2.json")["answers"] == {"age": "12"}
    play(platform)
    assert "words" in ask()["page"]
    assert alice.send("OPTIONS")["statusCode"] == 204


# Bad input


@pytest.mark.parametrize(
    ("query", "status"),
    [
        ("", 200),
        ("userId=alice", 404),
        ("projectId=", 404),
        ("projectId=nobody&userId=alice", 404),
        ("projectId=../maze&userId=alice", 404),
        ("projectId=maze%00&userId=alice", 404),
        ("projectId=maze&projectId=other&userId=alice", 404),
        ("projectId=maze&userId=", 400),
        ("projectId=maze&PROLIFIC_PID=a%20b", 400),
        ("projectId=maze&userId=../bob", 400),
        ("projectId=maze&userId=a%00b", 400),
        ("projectId=maze&userId=a&userId=b", 400),
        ("projectId=maze&userId=" + "x" * 65, 400),
        ("projectId=maze&userId=%ff", 400),
        ("&".join(f"a{n}=1" for n in range(100)), 400),
    ],
)
def test_a_broken_link_gets_an_error_page_and_changes_nothing(platform: FakePlatform, query: str, status: int) -> None:
    before = dict(platform.documents.kept)
    response = Browser(platform, query).send()
    assert response["statusCode"] == status
    assert response["headers"]["Content-Type"].startswith("text/html")
    assert "Traceback" not in response["body"]
    assert platform.documents.kept == before


def test_the_page_without_a_study_shows_the_form_of_a_link(platform: FakePlatform) -> None:
    assert "projectId=your-project&amp;userId=… - please" in Browser(platform, "").get()


def test_a_request_that_neither_reads_nor_answers_is_refused(platform: FakePlatform, alice: Browser) -> None:
    assert [alice.send(method)["statusCode"] for method in ("PUT", "DELETE", "PATCH")] == [405] * 3
    asked = alice.send("OPTIONS")
    assert (asked["statusCode"], asked["body"]) == (204, "")


@pytest.mark.parametrize("method", ["GET", "POST"])
def test_a_program_without_an_id_is_told_so_and_gets_none(platform: FakePlatform, method: str) -> None:
    body = "a=1" if method == "POST" else None
    answer = Browser(platform, "projectId=maze").send(method, body, accept="application/json", content_type=FORM)
    assert (answer["statusCode"], "Location" in answer["headers"]) == (400, False)
    assert json.loads(answer["body"])["message"]


def test_a_form_without_an_id_is_refused(platform: FakePlatform) -> None:
    answer = Browser(platform, "projectId=maze").post(consent="yes")
    assert (answer["statusCode"], "Location" in answer["headers"]) == (400, False)


def test_an_arrival_is_logged_once(platform: FakePlatform, alice: Browser, log: io.StringIO) -> None:
    for _ in range(2):
        alice.get()
    assert log.getvalue().count('"arrived"') == 1


def test_a_link_whose_project_no_study_can_have_costs_no_call(platform: FakePlatform, alice: Browser) -> None:
    assert calls(platform, lambda: Browser(platform, "projectId=../maze&userId=alice").send()) == []


def test_the_fields_of_a_recruiters_link_are_kept_up_to_a_length(platform: FakePlatform) -> None:
    long, longer = "k" * 64, "k" * 65
    Browser(platform, f"projectId=maze&userId=alice&{long}=1&{longer}=2&a={'v' * 257}").get()
    assert stored(platform, "participant.json")["link"] == {long: "1", "a": "v" * 256}


def test_the_fields_of_a_link_that_are_not_the_recruiters_are_not_kept(platform: FakePlatform) -> None:
    browser = Browser(platform, "projectId=maze&userId=alice&poll=3&signature=x&a=1")
    browser.send("POST", "b=1", accept="application/json", content_type=FORM)
    assert stored(platform, "participant.json")["link"] == {"a": "1"}


@pytest.mark.parametrize(
    ("query", "title", "text"),
    [
        ("projectId=maze&userId=../bob", "Kaputt", "Noch einmal kopieren"),
        ("projectId=maze&userId=a&assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE", "Eine Studie", "Eine Vorschau"),
    ],
)
def test_a_page_instead_of_the_study_is_in_its_language(query: str, title: str, text: str) -> None:
    words = {
        "language": "de",
        "brokenLink": "Kaputt",
        "brokenLinkText": "Noch einmal kopieren",
        "preview": "Eine Vorschau",
        "aStudy": "Eine Studie",
    }
    page = Browser(installed(study(texts=words, name="")), query).send()["body"]
    assert '<html lang="de">' in page
    assert f"<h1>{title}</h1>" in page
    assert text in page


def test_a_study_that_is_not_live_does_not_exist() -> None:
    platform = installed(study(live=False))
    response = Browser(platform).send()
    unknown = Browser(platform, "projectId=nobody&userId=alice").send()
    strip = re.compile(r"nonce[-=\"'\w]+")
    assert response["statusCode"] == 404
    assert strip.sub("", response["body"]) == strip.sub("", unknown["body"])


@pytest.mark.parametrize(
    ("body", "kind", "status"),
    [
        ("a=" + "x" * 300_000, FORM, 413),
        ("a=1", "text/plain", 415),
        (b"a=\xff", FORM, 400),
        ("&".join(f"f{n}=" for n in range(30_000)), FORM, 400),
    ],
)
def test_answers_that_cannot_be_stored_are_refused_and_the_participant_stays_at_the_step(
    platform: FakePlatform, alice: Browser, body: str | bytes, kind: str, status: int
) -> None:
    alice.get()
    before = dict(platform.documents.kept)
    response = alice.send("POST", body, content_type=kind)
    assert response["statusCode"] == status
    assert "no-store" not in response["headers"]["Cache-Control"]  # the browser keeps the form for Back
    assert platform.documents.kept == before


def test_a_program_whose_answers_are_refused_is_told_why(platform: FakePlatform, alice: Browser) -> None:
    answer = alice.send("POST", "a=1", content_type="text/plain", accept="application/json")
    assert answer["statusCode"] == 415
    assert json.loads(answer["body"])["message"] == (
        "Your answers were not saved. Answers are accepted from a form or as JSON, and this was neither. "
        "Please answer the page again."
    )


@pytest.mark.parametrize(
    ("body", "kind", "why"),
    [
        ("a=" + "x" * 300_000, FORM, "Zu lang."),
        ("a=1", "text/plain", "Answers are accepted from a form or as JSON"),  # no page of Hippodrome sends such a form
    ],
)
def test_a_form_is_refused_in_the_studys_own_words(body: str, kind: str, why: str) -> None:
    words = {
        "language": "de",
        "notSaved": "Nicht gespeichert",
        "notSavedText": "{why} Bitte zurück.",
        "formTooLong": "Zu lang.",
    }
    response = Browser(installed(study(texts=words))).send("POST", body, content_type=kind)
    assert "Nicht gespeichert" in response["body"]
    assert why in response["body"]
    assert "Bitte zurück." in response["body"]


@settings(max_examples=examples(60))
@given(st.text(max_size=80), st.binary(max_size=80), st.sampled_from(["GET", "POST", "PUT", "HEAD", "OPTIONS", "X"]))
def test_no_request_makes_the_function_fail(query: str, body: bytes, method: str) -> None:
    browser = Browser(installed(), query)
    response = browser.send(method, body, content_type=FORM)
    assert response["statusCode"] < 500


def test_a_failure_becomes_a_sentence_and_its_log_holds_no_answer(
    platform: FakePlatform, alice: Browser, log: io.StringIO
) -> None:
    page = alice.get()

    def fail() -> None:
        raise RuntimeError("could not store secret-answer of alice")

    platform.documents.before_write.append(fail)
    response = alice.answer(page, consent="secret-answer")
    assert response["statusCode"] == 500
    assert "reload this page to try again" in response["body"]
    logged = log.getvalue()
    assert "request failed" in logged
    assert "RuntimeError" in logged
    assert "secret-answer" not in response["body"] + logged
    assert "alice" not in response["body"] + logged


def test_no_id_and_no_answer_is_logged_in_a_whole_study(platform: FakePlatform, log: io.StringIO) -> None:
    test_a_participant_goes_from_the_link_to_the_completion_code(platform, Browser(platform))
    logged = log.getvalue()
    assert "answered" in logged
    for secret in ("alice", "snowman", "fun", "33"):
        assert secret not in re.sub(r'"(timestamp|location|xray_trace_id)":"[^"]*"', "", logged)


def test_script_in_an_answer_is_shown_as_text() -> None:
    platform = installed(study(steps=[Step("1", "questionnaire"), Step("finalStep", "debrief")], events=Events()))
    platform.documents.put(step_key("maze", "debrief"), b"You said {{ answers['1'].age }} to {{ participant.x }}")
    alice = Browser(platform, "projectId=maze&userId=alice&x=%3Cscript%3Ey%3C/script%3E")
    alice.answer(alice.get(), age="<script>alert(1)</script>")
    page = alice.get()
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    assert "<script>alert" not in page
    assert "<script>y" not in page


def test_only_pictures_beside_the_pages_are_served(platform: FakePlatform) -> None:
    platform.documents.put("maze/steps/maze.png", b"\x89PNG")
    place.use(platform)

    def ask(path: str) -> dict[str, Any]:
        return next_step.handler(http_event(path=path), None)

    found = ask("/steps/maze/maze.png")
    assert (found["statusCode"], found["headers"]["Content-Type"]) == (200, "image/png")
    assert base64.b64decode(found["body"]) == b"\x89PNG"
    assert "sandbox" in found["headers"]["Content-Security-Policy"]
    for path in ("/steps/maze/consent-0.html", "/steps/maze/../users/alice/x.png", "/steps/maze/none.png",
                 "/steps/other/maze.png", "/steps/maze", "/steps/maze/a\0.png"):  # fmt: skip
        assert ask(path)["statusCode"] == 404


def test_pages_are_compressed_for_browsers_that_accept_it(platform: FakePlatform, alice: Browser) -> None:
    plain = alice.send()
    for accepts, packed in [
        ("gzip, deflate, br", True),
        ("br;q=1.0, gzip;q=0.8", True),
        ("gzip;q=0", False),
        ("", False),
    ]:
        response = alice.send(accept_encoding=accepts)
        assert response["isBase64Encoded"] is packed
        assert (response["headers"].get("Content-Encoding") == "gzip") is packed
        body = gzip.decompress(base64.b64decode(response["body"])).decode() if packed else response["body"]
        assert len(body) == len(plain["body"])


# Cost


def calls(platform: FakePlatform, act: Any) -> list[str]:
    platform.documents.calls.clear()
    messages = len(platform.bus.sent)
    act()
    return platform.documents.calls + ["publish"] * (len(platform.bus.sent) - messages)


def test_a_page_is_read_again_when_its_project_is_registered_anew(platform: FakePlatform, alice: Browser) -> None:
    alice.get()
    for file in ("consent-0", "consent-1"):
        platform.documents.put(step_key("maze", file), b"A better page")
    platform.wait(seconds=60)
    assert "A better page" not in alice.get()
    platform.documents.put(MASTER_LIST, to_json(MasterList([study(version="2")])))
    platform.wait(seconds=60)
    assert "A better page" in alice.get()


def test_a_page_that_mentions_an_answer_reads_only_this_answer(platform: FakePlatform, alice: Browser) -> None:
    to_game(alice)
    play(platform)
    alice.answer(alice.get(), words="x")
    platform.documents.put(step_key("maze", "debrief"), b"{{ answers['3'].score }}")
    alice.get()
    assert calls(platform, alice.get) == ["list", "get"]
    assert "120" in alice.get()


def test_the_aws_calls_of_requests_with_a_full_cache(platform: FakePlatform, alice: Browser) -> None:
    for key in range(5):  # warm: project and pages are in the cache
        Browser(platform, f"projectId=maze&userId=u{key}").get()
    alice.query = "projectId=maze&userId=alice"
    page = alice.get()
    assert calls(platform, alice.get) == ["list"]
    assert calls(platform, lambda: alice.answer(page, consent="yes")) == ["put"]
    page = alice.get()
    assert calls(platform, alice.get) == ["list", "publish"]
    assert calls(platform, lambda: alice.answer(page, age="1")) == ["put"]
    assert calls(platform, alice.get) == ["list", "get"]
    assert calls(platform, lambda: poll(alice)) == ["get"]


def test_the_size_of_an_answer_does_not_depend_on_earlier_requests(platform: FakePlatform, alice: Browser) -> None:
    for _ in range(20):
        alice.get()
    alice.answer(alice.get(), consent="yes")
    first = len(platform.documents.kept["maze/users/alice/answers/1.json"][0])
    alice.answer(alice.get(), words="x" * 10_000)
    for _ in range(20):
        alice.get()
    play(platform)
    alice.answer(alice.get(), consent="yes")
    last = len(platform.documents.kept["maze/users/alice/answers/4.json"][0])
    assert abs(last - first) < 50
