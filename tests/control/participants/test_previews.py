"""Previews of links, and visitors without an invitation, get neither a record nor a server."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import ids
from hippodrome.control.model.project import Events, Project
from hippodrome.protocol.keys import NAME
from testing.fake_platform import FakePlatform
from testing.studies import SECRET, installed, study
from testing.visitors import Browser

LINK = "projectId=maze&userId=alice"
PEOPLE = (
    "Mozilla/5.0 (Windows NT 10.0; Win64; x64) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/142.0.0.0 Safari/537.36",
    "Mozilla/5.0 (Linux; Android 9; CUBOT X19) AppleWebKit/537.36 (KHTML, like Gecko) Chrome/120.0 Mobile Safari/537.36",
    "Mozilla/5.0 (iPhone; CPU iPhone OS 18_0 like Mac OS X) AppleWebKit/605.1.15 Mobile/15E148 [FBAN/FBIOS;FBAV/400.0]",
    "Mozilla/5.0 (iPhone; CPU iPhone OS 18_0 like Mac OS X) AppleWebKit/605.1.15 Mobile/15E148 Instagram 300.0.0.0",
    "Mozilla/5.0 (X11; Linux x86_64) AppleWebKit/537.36 (KHTML, like Gecko) HeadlessChrome/142.0 Safari/537.36",
    "",
)
PROGRAMS = (
    "facebookexternalhit/1.1 (+http://www.facebook.com/externalhit_uatext.php)",
    "Twitterbot/1.0",
    "Slackbot-LinkExpanding 1.0 (+https://api.slack.com/robots)",
    "Mozilla/5.0 (compatible; Discordbot/2.0; +https://discordapp.com)",
    "WhatsApp/2.23.20.0 A",
    "TelegramBot (like TwitterBot)",
    "LinkedInBot/1.0 (compatible; Mozilla/5.0; Apache-HttpClient +http://www.linkedin.com)",
    "Mozilla/5.0 (Windows NT 6.1; WOW64) SkypeUriPreview Preview/0.5 skype-url-preview@microsoft.com",
    "Mozilla/5.0 (compatible; Googlebot/2.1; +http://www.google.com/bot.html)",
    "Mozilla/5.0 (Macintosh; Intel Mac OS X 10_15_7) AppleWebKit/605.1.15 Safari/605.1.15 (Applebot/0.1)",
    "Mozilla/5.0 (compatible; Baiduspider/2.0; +http://www.baidu.com/search/spider.html)",
    "Mastodon/4.2.0 (http.rb/5.1.1; +https://mastodon.social/) Bot",
    "meta-externalagent/1.1 (+https://developers.facebook.com/docs/sharing/webmasters/crawler)",
)
AHEAD = (
    {"sec_purpose": "prefetch"},
    {"sec_purpose": "prefetch;prerender"},
    {"sec_purpose": "prefetch;anonymous-client-ip"},
    {"purpose": "prefetch"},
    {"purpose": "Preview"},
    {"purpose": " prerender"},
    {"x_purpose": "preview"},
    {"x_moz": "prefetch"},
)


@pytest.fixture
def project() -> Project:
    """The server starts at the first step."""
    return study(events=Events("1", "4"))


def untouched(platform: FakePlatform) -> bool:
    return not platform.bus.sent and not any("/users/" in key for key in platform.documents.kept)


@pytest.mark.parametrize("agent", PEOPLE)
def test_a_persons_browser_begins_the_study(platform: FakePlatform, agent: str) -> None:
    Browser(platform, LINK).get(user_agent=agent)
    assert not untouched(platform)


@pytest.mark.parametrize("agent", PROGRAMS)
def test_a_program_that_previews_a_link_sees_the_study_and_begins_nothing(platform: FakePlatform, agent: str) -> None:
    for query in (LINK, "projectId=maze"):
        page = Browser(platform, query).get(user_agent=agent)
        assert "A maze" in page
        assert "open the link in a browser" in page
        assert "<form" not in page
        assert not re.search("agree|alice", page)
    assert untouched(platform)


@pytest.mark.parametrize("headers", AHEAD)
def test_a_prefetch_of_a_browser_is_refused_and_not_cached(platform: FakePlatform, headers: dict[str, str]) -> None:
    """After any status but a 2xx, the browser asks again when the person opens the link."""
    for query in (LINK, "projectId=maze"):
        answer = Browser(platform, query).send(**headers)
        assert (answer["statusCode"], answer["headers"]["Cache-Control"], answer["body"]) == (403, "no-store", "")
    assert untouched(platform)
    Browser(platform, LINK).get()
    assert not untouched(platform)


@pytest.mark.parametrize("headers", [{"user_agent": PROGRAMS[0]}, *AHEAD])
def test_a_form_that_is_sent_is_no_preview(platform: FakePlatform, headers: dict[str, str]) -> None:
    alice = Browser(platform, LINK)
    alice.get()
    form = f"hippodrome-step=1&hippodrome-ticket={ids.ticket(SECRET, 'alice', '1')}&consent=yes"
    alice.send("POST", form, content_type="application/x-www-form-urlencoded", **headers)
    assert "maze/users/alice/answers/1.json" in platform.documents.kept


@pytest.mark.parametrize("query", [LINK, "projectId=maze", "projectId=maze&workerId=W1"])
def test_the_preview_of_a_task_on_mturk_begins_nothing(platform: FakePlatform, query: str) -> None:
    page = Browser(platform, f"{query}&assignmentId=ASSIGNMENT_ID_NOT_AVAILABLE&hitId=H").get()
    assert "This is a preview." in page
    assert untouched(platform)
    Browser(platform, f"{LINK}&assignmentId=3RANDOM&hitId=H").get()
    assert not untouched(platform)


@pytest.mark.parametrize("query", [LINK, "projectId=maze"])
def test_a_head_request_begins_nothing(platform: FakePlatform, query: str) -> None:
    assert Browser(platform, query).send("HEAD")["statusCode"] in (200, 302)
    assert untouched(platform)


@given(st.text(max_size=60))
def test_any_user_agent_gets_an_answer(agent: str) -> None:
    platform = installed()
    assert Browser(platform, LINK).send(user_agent=agent)["statusCode"] == 200


# Signed links


def invited(user: str = "alice", project: str = "maze", secret: str = SECRET) -> str:
    return f"projectId={project}&userId={user}&signature={ids.link_signature(secret, project, user)}"


@pytest.fixture
def closed() -> FakePlatform:
    return installed(study(signed_links=True, events=Events("1", "4")))


def test_a_signed_link_leads_through_the_study(closed: FakePlatform) -> None:
    alice = Browser(closed, invited())
    answer = alice.answer(alice.get(), consent="yes")
    assert answer["statusCode"] == 303
    alice.query = answer["headers"]["Location"].partition("?")[2]
    assert "Age" in alice.get()
    kept = closed.documents.kept["maze/users/alice/participant.json"][0]
    assert ids.link_signature(SECRET, "maze", "alice").encode() not in kept


@pytest.mark.parametrize(
    "query",
    [
        "projectId=maze",
        LINK,
        f"{LINK}&signature=",
        f"{LINK}&signature={ids.link_signature(SECRET, 'maze', 'bob')}",
        f"{LINK}&signature={ids.link_signature(SECRET, 'other', 'alice')}",
        f"{LINK}&signature={ids.link_signature('another', 'maze', 'alice')}",
        f"{LINK}&signature={ids.ticket(SECRET, 'alice', '1')}",
        f"{LINK}&signature={ids.completion_code(SECRET, 'alice')}",
        f"{invited()}&signature=x",
        f"{invited().replace('userId', 'workerId')}&userId=bob",
    ],
)
@pytest.mark.parametrize("method", ["GET", "HEAD", "POST"])
def test_a_visitor_without_a_valid_signature_gets_nothing(closed: FakePlatform, query: str, method: str) -> None:
    body = f"hippodrome-step=1&hippodrome-ticket={ids.ticket(SECRET, 'alice', '1')}" if method == "POST" else None
    answer = Browser(closed, query).send(method, body, content_type="application/x-www-form-urlencoded")
    assert answer["statusCode"] in (400, 403)
    assert "agree" not in answer["body"]
    assert untouched(closed)


def test_a_link_with_a_wrong_signature_is_said_to_be_broken(closed: FakePlatform) -> None:
    answer = Browser(closed, f"{LINK}&signature=x").send()
    assert answer["statusCode"] == 403
    assert "This link does not work" in answer["body"]


def test_a_link_without_an_id_is_refused_and_no_id_is_made(closed: FakePlatform) -> None:
    answer = Browser(closed, "projectId=maze").send()
    assert (answer["statusCode"], "Location" in answer["headers"]) == (403, False)
    assert "by invitation" in answer["body"]


IDS = st.from_regex(NAME, fullmatch=True)


@given(IDS, IDS, st.text(max_size=40), st.integers(0, 31), st.sampled_from("0123456789abcdef"))
def test_no_other_signature_opens_a_link(user: str, other: str, guess: str, at: int, digit: str) -> None:
    right = ids.link_signature(SECRET, "maze", user)
    assert re.fullmatch(r"[0-9a-f]{32}", right)
    for wrong in (
        guess,
        f"{right[:at]}{digit}{right[at + 1 :]}",
        right[:at],
        ids.link_signature(SECRET, "maze", other),
    ):
        assert ids.secrets_equal(wrong, right) is (wrong == right)
    assert (ids.link_signature(SECRET, "maze", other) == right) is (other == user)
    # Values that the secret signs for one purpose are no proof for another.
    assert right not in (ids.ticket(SECRET, "maze", user), ids.ticket(SECRET, user, other))
