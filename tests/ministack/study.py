"""A small study, and a participant with a browser."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import yaml

PROJECT = "tiny"
GAME, AFTER = "3", "4"
SECRET_WORD = "kumquat"  # a participant's answer, which must be stored nowhere else

CONFIG: dict[str, Any] = {
    "project": {
        "id": PROJECT,
        "name": "A tiny study",
        "live": True,
        "maxRuntime": 10,
        "useAWS": True,
        "awsSetup": {"cpu": 0.5, "memory": 1},
        "steps": {1: "consent", 2: "about", 3: "game", 4: "after", "finalStep": "end"},
        "events": {"startServerStep": 2, "stopServerStep": 4},
    },
    "trial": {"game": "tiny", "maxEpisodes": 1, "actionSpace": ["noop", "right"], "ui": {"right": True}},
}
PAGES = {
    "consent": '<h1>Consent</h1><button name="consent" value="yes">I agree</button>',
    "about": '<h1>About you</h1><label>Age <input name="age" type="number"></label><label>Word <input name="word"></label>',
    "after": '<h1>After</h1><label>Fun <input name="fun" type="range"></label>',
    "end": '<h1>The end</h1><p class="code">{{ completion_code }}</p>',
}
AGENT = '''
"""Nothing happens, for five steps."""


class Agent:
    def start(self, game):
        pass

    def reset(self, seed=None):
        self.t = 0
        return 0, {}

    def step(self, action):
        self.t += 1
        return 0, 1.0, self.t >= 5, False, {}

    def render(self):
        import numpy

        return numpy.zeros((8, 8, 3), numpy.uint8)

    def close(self):
        pass
'''


def write_project(folder: Path) -> Path:
    """Write the study's project folder."""
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text(yaml.safe_dump(CONFIG, sort_keys=False))
    (folder / "agent.py").write_text(AGENT)
    for page, source in PAGES.items():
        (folder / "steps" / f"{page}.html").write_text(source)
    return folder


class Person:
    """A participant with a browser at the study's address."""

    def __init__(self, browser: httpx.Client, user: str) -> None:
        self.browser, self.user = browser, user
        self.link = f"/next?projectId={PROJECT}&userId={user}"
        self.page = ""

    def look(self) -> str:
        """Open the link, or reload."""
        found = self.browser.get(self.link)
        assert found.status_code == 200, found.text
        assert found.headers["content-type"].startswith("text/html")
        self.page = html.unescape(found.text)
        return self.page

    @property
    def at(self) -> str:
        """The step whose page is open."""
        return re.findall(r'data-step="([^"]+)"', self.page)[0]

    @property
    def proof(self) -> dict[str, str]:
        """The step and ticket in the form of the page."""
        return dict(re.findall(r'name="(hippodrome-(?:step|ticket))" value="([^"]*)"', self.page))

    def answer(self, **fields: str) -> None:
        """Submit the page that is open, and follow to the next."""
        sent = self.browser.post(self.link, data={**self.proof, **fields})
        assert sent.status_code == 303, sent.text
        to = urlsplit(sent.headers["location"])
        assert f"{to.path}?{to.query}" == self.link
        self.look()

    def to_the_game(self, word: str = "tea") -> None:
        self.look()
        self.answer(consent="yes")
        self.answer(age="33", word=word)
        assert self.at == GAME

    def poll(self) -> Any:
        """Return the answer to a poll of the waiting page."""
        found = self.browser.get(f"{self.link}&poll={GAME}", headers={"Accept": "application/json"})
        assert found.status_code == 200, found.text
        return found.json()

    def is_told(self, state: str) -> Any:
        """Return the answer to a poll of the waiting page if it has this state, else None."""
        told = self.poll()
        return told if told["state"] == state else None


class Member(Person):
    """A participant of the study when it is played in pairs."""

    def poll(self) -> Any:
        """Return the answer to a poll of the lobby's page, which sends its ticket."""
        link = f"{self.link}&poll={GAME}&ticket={self.proof['hippodrome-ticket']}"
        found = self.browser.get(link, headers={"Accept": "application/json"})
        assert found.status_code == 200, found.text
        return found.json()


class Trial:
    """A participant's server, as far as it stores things: it knows its environment, and has no rights on AWS."""

    def __init__(self, browser: httpx.Client, task: Any) -> None:
        self.browser = browser
        overrides = task["overrides"]["containerOverrides"][0]
        self.told = {one["name"]: one["value"] for one in overrides["environment"]}

    def asks(self, method: str, key: str, body: bytes = b"", **change: str) -> httpx.Response:
        """Return the site's answer to a server that asks for this presigned request."""
        who = {"server": self.told["SERVER"], "credential": self.told["CREDENTIAL"], **change}
        return self.browser.post("/sign", json={**who, "requests": [{"method": method, "key": key, "size": len(body)}]})

    def does(self, method: str, key: str, body: bytes = b"") -> httpx.Response:
        """Ask for a presigned request, and send it."""
        answer = self.asks(method, key, body)
        assert answer.status_code == 200, answer.text
        (request,) = answer.json()["requests"]
        return httpx.request(
            request["method"], request["url"], headers=request["headers"], content=body or None, verify=False
        )


def trial_done(score: int) -> bytes:
    """Return the documents that the trial writes at the end of a game."""
    return json.dumps({"step": GAME, "answers": {"score": score}}).encode()
