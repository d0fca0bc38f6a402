"""The game step of a study for several players, through `next_step`: lobby, session, unmatched."""

from __future__ import annotations

import json
import re
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec
import pytest

from hippodrome.control.lobby import entries as folder
from hippodrome.control.model import ids, server
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project, step_key
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import Reason
from hippodrome.control.ports import Address, Topic
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import installed as place
from hippodrome.functions import next_step
from hippodrome.protocol.keys import answer_key
from hippodrome.protocol.session import member_token
from testing.aws_events import FORM, http_event
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.studies import SECRET, installed, study
from testing.visitors import Browser, hidden

STUDY: dict[str, Any] = {"players": 2, "patience": 60, "trial": {"game": "x", "players": {"a": "human", "b": "human"}}}
NOTHING: list[str] = []


@pytest.fixture
def project() -> Project:
    return study(**STUDY)


class Player(Browser):
    """A participant's browser at the game step: its page, and the answers to its polls."""

    def __init__(self, platform: FakePlatform, user: str, query: str = "") -> None:
        super().__init__(platform, f"projectId=maze&userId={user}{query}")
        self.user = user

    def to_game(self) -> Player:
        self.answer(self.get(), consent="yes")
        self.answer(self.get(), age="33")
        return self

    @property
    def data(self) -> dict[str, Any]:
        """The data that the page hands to its script."""
        found = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', self.get(), re.DOTALL)
        assert found
        return dict(json.loads(found[1]))

    def poll(self, address: str | None = None) -> dict[str, Any]:
        """Return the answer of the page's poll address."""
        query = urlsplit(address or self.data["poll"]).query
        answer = next_step.handler(http_event("GET", query, None, headers={"accept": "application/json"}), None)
        return {"status": answer["statusCode"], **json.loads(answer["body"])}

    def close(self, page: str, **changes: str) -> int:
        """Send what the page sends when it is closed; the status of the answer."""
        fields = {**hidden(page), "hippodrome-action": "leave", **changes}
        body = "&".join(f"{name}={value}" for name, value in fields.items())
        return int(self.send("POST", body, content_type=FORM)["statusCode"])


def waiting(platform: FakePlatform) -> list[str]:
    return [key for key in platform.documents.kept if key.startswith(folder.FOLDER)]


def matched(platform: FakePlatform, *players: Player) -> list[dict[str, Any]]:
    """Poll until these players are in a session; the answers to their last polls."""
    addresses = [player.data["poll"] for player in players]
    for _ in range(4):
        platform.wait(seconds=2)
        told = [player.poll(address) for player, address in zip(players, addresses, strict=True)]
    assert {one["state"] for one in told} == {"queued"}
    return told


def matched_pair(platform: FakePlatform) -> tuple[Player, Player]:
    """Return ann and bob, who have come to the game and are in a session."""
    ann, bob = (Player(platform, user).to_game() for user in ("ann", "bob"))
    matched(platform, ann, bob)
    return ann, bob


def serve(platform: FakePlatform) -> str:
    """Start the server of the one session, up to ready. Its token."""
    [sid] = {m["userId"] for topic, m in platform.bus.sent if topic is Topic.START and m["userId"].startswith("s.")}
    return serve_owner(platform, sid)


def serve_owner(platform: FakePlatform, owner: str) -> str:
    Servers(platform).start(StartServer("maze", owner))
    repository = Repository(platform.documents)
    stored = repository.server(ids.server_label("maze", owner))
    assert stored
    named = server.naming(stored.server, "task", Address("203.0.113.9", 5000), platform.now())
    platform.documents.put(server.key(stored.server.label), to_json(server.ready(named, platform.now())))
    return SecretCache(platform.documents).token(named)


def test_the_lobby_shows_how_many_are_there_and_what_happens_when_patience_ends(platform: FakePlatform) -> None:
    ann = Player(platform, "ann").to_game()
    state = ann.data["state"]
    assert state["state"] == "lobby"
    assert {key: state[key] for key in ("players", "here", "seconds", "patience", "then", "proposed")} == {
        "players": 2, "here": 1, "seconds": 0, "patience": 60, "then": "unmatched", "proposed": False,
    }  # fmt: skip
    assert (state["userId"], state["step"]) == ("ann", "3")
    platform.wait(seconds=7)
    assert ann.poll()["seconds"] == 7
    bob = Player(platform, "bob").to_game()
    bob.get()
    assert ann.poll()["here"] == 2


def test_a_pair_gets_one_server_and_each_a_token_of_their_own(platform: FakePlatform) -> None:
    ann, bob = matched_pair(platform)
    token = serve(platform)
    told = {player.user: player.poll() for player in (ann, bob)}
    assert {one["url"] for one in told.values()} == {told["ann"]["url"]}
    for user, state in told.items():
        assert (state["state"], state["session"], state["players"], state["members"]) == ("ready", True, 2, 2)
        assert state["token"] == member_token(token, user)
    pages = ann.get() + bob.get()
    assert token not in pages
    assert token not in json.dumps(told)


def test_an_unmatched_participant_goes_on_and_pages_can_show_it(platform: FakePlatform, project: Project) -> None:
    said = b"{% if participant.unmatched %}alone{% else %}together {{ participant.members }}{% endif %} {{ completion_code }}"
    for page in ("survey", "debrief"):
        platform.documents.put(step_key("maze", page), said)
    ann = Player(platform, "ann").to_game()
    address = ann.data["poll"]
    for _ in range(29):
        platform.wait(seconds=2)
        assert ann.poll(address)["state"] == "lobby"
    platform.wait(seconds=2)
    assert ann.poll(address)["state"] == "unmatched"
    page = ann.get()
    other = ids.completion_code(project.secret, "ann", "unmatched")
    assert f"alone {other}" in page
    assert ids.completion_code(project.secret, "ann") not in page
    stored = json.loads(platform.documents.kept["maze/users/ann/answers/3.json"][0])
    assert stored["answers"] == {"outcome": "unmatched"}
    membership = json.loads(platform.documents.kept["maze/users/ann/session.json"][0])
    assert (membership["session"], membership["unmatched"], membership["completionCode"]) == (None, True, other)
    assert ann.poll(address)["state"] == "unmatched"  # a second tab


def test_opening_the_link_at_the_end_of_patience_shows_the_next_step_at_once(platform: FakePlatform) -> None:
    ann = Player(platform, "ann").to_game()
    address = ann.data["poll"]
    for _ in range(29):
        platform.wait(seconds=2)
        ann.poll(address)
    platform.wait(seconds=3)
    assert "<textarea" in ann.get()


def test_members_of_a_session_are_not_unmatched(platform: FakePlatform) -> None:
    platform.documents.put(step_key("maze", "survey"), b"{{ participant.unmatched }} {{ participant.members }}")
    ann, _ = matched_pair(platform)
    platform.documents.put("maze/users/ann/answers/3.json", b'{"answers": {}}')
    assert "False 2" in ann.get()


def test_a_participant_who_closes_the_page_leaves_the_lobby_at_once_without_a_redirect(platform: FakePlatform) -> None:
    ann, bob = (Player(platform, user).to_game() for user in ("ann", "bob"))
    page = ann.get()
    platform.wait(seconds=2)
    assert ann.close(page) == 204
    platform.wait(seconds=1)
    assert bob.data["state"]["here"] == 1


def test_leaving_the_lobby_needs_the_ticket_of_the_step(platform: FakePlatform) -> None:
    ann, bob = (Player(platform, user).to_game() for user in ("ann", "bob"))
    page = ann.get()
    assert ann.close(page, **{"hippodrome-ticket": "0" * 32}) == 204
    assert bob.data["state"]["here"] == 2


def test_leaving_changes_nothing_for_a_member(platform: FakePlatform) -> None:
    ann, bob = (Player(platform, user).to_game() for user in ("ann", "bob"))
    page = ann.get()
    matched(platform, ann, bob)
    before = dict(platform.documents.kept)
    assert ann.close(page) == 204
    assert platform.documents.kept == before


@pytest.mark.parametrize("query", ["poll=3", "poll=3&ticket=0", "poll=1&ticket=0", "poll=", "poll=3&ticket=%00"])
def test_polling_for_another_participant_needs_their_ticket(platform: FakePlatform, query: str) -> None:
    Player(platform, "ann").to_game()
    before = dict(platform.documents.kept)
    mallory = Player(platform, "ann")
    assert mallory.poll(f"?projectId=maze&userId=ann&{query}")["status"] == 403
    assert platform.documents.kept == before


def test_a_ticket_of_another_step_or_participant_opens_no_lobby(platform: FakePlatform, project: Project) -> None:
    before = dict(platform.documents.kept)
    ann = Player(platform, "ann")
    for ticket in (ids.ticket(project.secret, "ann", "1"), ids.ticket(project.secret, "bob", "3")):
        assert ann.poll(f"?projectId=maze&userId=ann&poll=3&ticket={ticket}")["status"] == 403
    consent = ids.ticket(project.secret, "ann", "1")
    assert ann.poll(f"?projectId=maze&userId=ann&poll=1&ticket={consent}")["status"] == 403
    assert platform.documents.kept == before


def test_a_signed_link_is_needed_where_links_are_signed() -> None:
    signed = study(**STUDY, signed_links=True)
    platform = installed(signed)
    signature = ids.link_signature(signed.secret, "maze", "ann")
    ann = Player(platform, "ann", f"&signature={signature}").to_game()
    address = ann.data["poll"]
    assert ann.poll(address)["state"] == "lobby"
    before = dict(platform.documents.kept)
    unsigned = address.replace(signature, "0" * 32)
    assert ann.poll(unsigned)["status"] == 400  # as HIPPO answers a program
    assert platform.documents.kept == before


def test_a_form_for_another_server_asks_for_the_sessions_next_server(platform: FakePlatform) -> None:
    ann, _ = matched_pair(platform)
    serve(platform)
    membership = Repository(platform.documents).membership("maze", "ann")
    assert membership
    stored = Repository(platform.documents).server(ids.server_label("maze", str(membership.session)))
    assert stored
    ended = server.close(stored.server, server.Reason.ENDED, platform.now())
    platform.documents.put(server.key(ended.label), to_json(ended))
    platform.bus.sent.clear()
    ann.send(
        "POST",
        "&".join(f"{k}={v}" for k, v in hidden(ann.get()).items()) + "&hippodrome-action=restart",
        content_type=FORM,
    )
    assert [m["userId"] for topic, m in platform.bus.sent if topic is Topic.START] == [membership.session]


def test_a_member_goes_on_without_a_game_that_failed_and_the_others_may_still_try_again(platform: FakePlatform) -> None:
    ann, bob = matched_pair(platform)
    serve(platform)
    membership = Repository(platform.documents).membership("maze", "ann")
    assert membership
    stored = Repository(platform.documents).server(ids.server_label("maze", str(membership.session)))
    assert stored
    lost = msgspec.structs.replace(server.close(stored.server, Reason.LOST, platform.now()), attempt=3)
    platform.documents.put(server.key(lost.label), to_json(lost))
    form = "&".join(f"{k}={v}" for k, v in hidden(ann.get()).items())
    ann.send("POST", f"{form}&hippodrome-action=without", content_type=FORM)
    answers = [key.split("/")[2] for key in platform.documents.kept if key.endswith("/answers/3.json")]
    assert answers == ["ann"]
    platform.bus.sent.clear()
    form = "&".join(f"{k}={v}" for k, v in hidden(bob.get()).items())
    bob.send("POST", f"{form}&hippodrome-action=restart", content_type=FORM)
    started = [(m["userId"], m["attempt"]) for topic, m in platform.bus.sent if topic is Topic.START]
    assert started == [(membership.session, 4)]


def test_a_program_in_the_lobby_gets_the_page_wait_as_from_hippo(platform: FakePlatform) -> None:
    ann = Player(platform, "ann").to_game()
    answer = json.loads(ann.send(accept="application/json")["body"])
    assert (answer["page"], answer["state"]) == ("wait", "lobby")


def register(platform: FakePlatform, project: Project, *, live: bool) -> None:
    platform.documents.put(MASTER_LIST, to_json(MasterList([msgspec.structs.replace(project, live=live)])))
    platform.wait(seconds=60)


def told_of(browser: Browser) -> tuple[int, str]:
    answer = browser.send()
    return answer["statusCode"], re.sub(r"nonce[-=\"'\w]+", "", answer["body"])


def test_members_whose_game_ends_after_the_study_is_closed_get_the_same_answer_as_a_single_player(
    platform: FakePlatform, project: Project
) -> None:
    """When the study is open again, they go on where they were: docs/config.md, "closing"."""
    ann, bob = matched_pair(platform)
    addresses = [player.data["poll"] for player in (ann, bob)]
    register(platform, project, live=False)
    for user in ("ann", "bob"):
        platform.documents.put(answer_key("maze", user, "3"), b'{"outcome": "finished"}')
    alone = Player(alone_platform := installed(study()), "ann").to_game()
    address_of_one = alone.data["poll"]
    register(alone_platform, study(), live=False)
    alone_platform.documents.put(answer_key("maze", "ann", "3"), b"{}")
    said, polled = told_of(alone), alone.poll(address_of_one)
    assert said[0] == 404
    assert "Study not found" in said[1]
    place.use(platform)
    assert [told_of(player) for player in (ann, bob)] == [said, said]
    assert [player.poll(address) for player, address in zip((ann, bob), addresses, strict=True)] == [polled, polled]
    register(platform, project, live=True)
    for player in (ann, bob):
        assert hidden(player.get())["hippodrome-step"] == "4"


def test_a_study_for_one_has_no_lobby() -> None:
    platform = installed(study())
    ann = Player(platform, "ann").to_game()
    platform.documents.calls.clear()
    data = ann.data
    assert data["state"]["state"] == "queued"
    assert parse_qs(urlsplit(data["poll"]).query).keys() == {"projectId", "userId", "poll"}
    assert platform.documents.calls == ["list", "get"]
    assert waiting(platform) == NOTHING


# Another number of players is registered

THREE: dict[str, Any] = {
    "players": 3,
    "trial": {"game": "x", "players": {"a": "human", "b": "human", "c": "human"}, "afterAbsent": "policy", "keys": {"x": "up"}},
}  # fmt: skip


def register_three(platform: FakePlatform) -> None:
    """Register the study again, as `registry.register` enters it; functions see it ten seconds later."""
    before = study(**STUDY)
    again = study(**{**STUDY, **THREE}).following(before)
    platform.documents.keep(MASTER_LIST, to_json(MasterList([again])))
    platform.wait(seconds=11)


def test_the_page_of_a_pair_stays_that_of_a_pair_when_another_number_is_registered(platform: FakePlatform) -> None:
    """Both before and after its server has a record."""
    ann, _ = matched_pair(platform)
    register_three(platform)
    for _ in range(2):
        page, data = ann.get(), ann.data
        assert (data["players"], data["state"]["players"], data["state"]["members"]) == (2, 2, 2)
        assert data["absentEnds"]
        assert "This is a game for two people." in page
        assert ann.poll()["players"] == 2
        serve(platform)


def test_a_start_message_that_a_pairs_page_sends_again_is_for_two_players(platform: FakePlatform) -> None:
    ann, _ = matched_pair(platform)
    register_three(platform)
    platform.bus.sent.clear()
    platform.wait(seconds=31)
    ann.get()
    [(_, message)] = platform.bus.sent
    assert message["players"] == 2


def test_a_participant_in_the_lobby_gets_the_new_number_of_players_by_page_and_poll(platform: FakePlatform) -> None:
    ann = Player(platform, "ann").to_game()
    assert ann.data["players"] == 2
    register_three(platform)
    assert ann.poll()["players"] == 3
    assert (ann.data["players"], ann.data["absentEnds"]) == (3, False)
    assert "This is a game for 3 people." in ann.get()


def test_a_missing_page_that_the_pairs_earlier_registration_named_is_left_out(platform: FakePlatform) -> None:
    ann, _ = matched_pair(platform)
    before = study(**{**STUDY, "trial": {**STUDY["trial"], "instructions": "rules", "betweenEpisodes": "consent-0"}})
    platform.documents.keep(MASTER_LIST, to_json(MasterList([study(**{**STUDY, **THREE}).following(before)])))
    platform.wait(seconds=11)
    page = ann.get()
    assert 'id="text-betweenEpisodes"' in page
    assert 'id="text-instructions"' not in page


# One player was registered before

ONE: dict[str, Any] = {"trial": {"game": "alone", "keys": {"x": "up"}}}


def register_two(platform: FakePlatform) -> None:
    again = study(**STUDY).following(study(**ONE))
    platform.documents.keep(MASTER_LIST, to_json(MasterList([again])))
    platform.wait(seconds=11)


@pytest.fixture
def for_one() -> FakePlatform:
    return installed(study(**ONE))


def test_a_participant_who_plays_alone_stays_in_their_own_game_when_several_players_are_registered(
    for_one: FakePlatform,
) -> None:
    """The open page, and the page when it is loaded again, is that of their server; the next participant is in the lobby."""
    ann = Player(for_one, "ann").to_game()
    token = serve_owner(for_one, "ann")
    address, before = ann.data["poll"], ann.data
    register_two(for_one)
    assert {key: ann.poll(address)[key] for key in ("state", "token")} == {"state": "ready", "token": token}
    again = ann.data
    assert again["state"] | {"seconds": 0} == before["state"] | {"seconds": 0}
    assert {key: again.get(key) for key in before} | {"state": 0} == before | {"state": 0}
    assert 'id="lobby"' not in ann.get()
    bob = Player(for_one, "bob").to_game()
    assert bob.data["state"]["state"] == "lobby"


@pytest.mark.parametrize("how", ["lost", "stopped"])
def test_participants_keep_their_own_game_while_it_has_a_server_or_a_next_one(for_one: FakePlatform, how: str) -> None:
    ann = Player(for_one, "ann").to_game()
    serve_owner(for_one, "ann")
    address = ann.data["poll"]
    register_two(for_one)
    repository = Repository(for_one.documents)
    stored = repository.server(ids.server_label("maze", "ann"))
    assert stored
    closed = server.close(stored.server, Reason.LOST if how == "lost" else Reason.STOPPED, for_one.now())
    for_one.documents.put(server.key(stored.server.label), to_json(closed))
    said = ann.poll(address)
    if how == "lost":
        assert (said["state"], said["replaces"]) == ("queued", True)
        assert ann.data["state"]["state"] == "queued"
    else:
        assert said["state"] == "ended", "so that the page is loaded again"
        assert ann.data["state"]["state"] == "lobby"


def test_a_page_of_the_lobby_is_told_of_its_session_also_with_an_old_ticket(for_one: FakePlatform) -> None:
    register_two(for_one)
    ann, _ = matched_pair(for_one)
    address = ann.data["poll"]
    old = re.sub("ticket=[0-9a-f]+", "ticket=0", address)
    assert old != address
    assert (ann.poll(old)["status"], ann.poll(old)["state"]) == (200, "queued")
    assert ann.poll(old.replace("&ticket=0", ""))["state"] == "ended", "so that a page for one is loaded again"


def test_a_participant_whose_own_server_has_not_started_gets_the_lobby(for_one: FakePlatform) -> None:
    ann = Player(for_one, "ann").to_game()
    address = ann.data["poll"]
    register_two(for_one)
    assert ann.poll(address)["state"] == "ended"
    assert ann.data["state"]["state"] == "lobby"


def test_a_poll_without_a_ticket_is_refused_if_the_first_registration_was_for_several_players(
    platform: FakePlatform,
) -> None:
    Player(platform, "ann").to_game()
    answer = next_step.handler(
        http_event("GET", "projectId=maze&userId=ann&poll=3", None, headers={"accept": "application/json"}), None
    )
    assert answer["statusCode"] == 403


def test_a_missing_page_that_only_the_registration_for_one_player_named_is_left_out(for_one: FakePlatform) -> None:
    ann = Player(for_one, "ann").to_game()
    serve_owner(for_one, "ann")
    before = study(trial={**ONE["trial"], "instructions": "rules", "betweenEpisodes": "consent-0"})
    project = study(**STUDY).following(before)
    for_one.documents.keep(MASTER_LIST, to_json(MasterList([project])))
    for_one.wait(seconds=11)
    page = ann.get()
    assert 'id="text-betweenEpisodes"' in page
    assert 'id="text-instructions"' not in page


def test_a_member_plays_with_the_others_even_if_a_server_of_their_own_was_started(for_one: FakePlatform) -> None:
    """A function that had not read the new registration has started that server. A page that was made for one player is loaded again."""
    ann = Player(for_one, "ann").to_game()
    address = ann.data["poll"]
    register_two(for_one)
    matched(for_one, ann, bob := Player(for_one, "bob").to_game())
    token = serve(for_one)
    start_for_one(for_one, "ann")
    state = ann.data["state"]
    assert (state["session"], state["token"]) == (True, member_token(token, "ann"))
    assert ann.poll(address)["state"] == "ended"
    assert [bob.poll()["state"], ann.poll()["state"]] == ["ready", "ready"]


def start_for_one(platform: FakePlatform, user: str) -> None:
    """Start the participant's own server, as a function does that still knows the registration for one player."""
    other = installed(study(**ONE))
    serve_owner(other, user)
    key = server.key(ids.server_label("maze", user))
    platform.documents.put(key, other.documents.kept[key][0])
    place.use(platform)


def test_a_function_with_an_old_registration_reads_the_new_one_for_a_poll_of_the_lobby(for_one: FakePlatform) -> None:
    """Otherwise the page would treat the participant as matched."""
    ann = Player(for_one, "ann").to_game()
    assert ann.data["state"]["state"] == "queued"
    for_one.documents.keep(MASTER_LIST, to_json(MasterList([study(**STUDY).following(study(**ONE))])))
    ticket = ids.ticket(SECRET, "ann", "3")
    assert ann.poll(f"?projectId=maze&userId=ann&poll=3&ticket={ticket}")["state"] == "lobby"
