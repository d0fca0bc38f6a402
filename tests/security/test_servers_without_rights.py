"""A malicious agent.py on a real server: it knows all that its server knows, and gets no data of other participants."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Server
from hippodrome.control.storage.secret import KEY, SecretCache
from hippodrome.protocol.keys import handover_key
from testing.strict_s3 import BUCKET, StrictS3
from testing.studies import study

ROOT = Path(__file__).resolve().parents[2]
MALLORY, ALICE = "mallory", "alice"
SECRETS = ("alice's answer", "the other project's answer", "alice's recording", "the master list")

# It runs as the researcher's code does: the trial imports it into its process. It writes what it got into a file.
ATTACK = r'''
import gc, http.client, json, os, re, sys, urllib.parse
from pathlib import Path

PLAN = json.loads(Path(__file__).with_name("plan.json").read_text())
GOT = {}

def send(method, url, body=None, headers=None):
    parts = urllib.parse.urlsplit(url)
    link = http.client.HTTPConnection(parts.hostname, parts.port, timeout=60)
    try:
        link.request(method, parts.path + ("?" + parts.query if parts.query else ""), body, headers or {})
        answer = link.getresponse()
        return answer.status, answer.read().decode("latin-1")
    except Exception as error:
        return 0, type(error).__name__
    finally:
        link.close()

def own():
    """The server's own credential: from what the process was started with, or from its memory."""
    started = dict(line.split("=", 1) for line in Path("/proc/self/environ").read_text().split("\0") if "=" in line)
    GOT["environment"] = sorted(set(os.environ) & {"TOKEN", "CREDENTIAL", "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI"})
    from hippodrome.trial.recordings.store import PresignedStore
    stores = [found for found in gc.get_objects() if isinstance(found, PresignedStore)]
    return stores[0]._url, stores[0]._server, stores[0]._credential, started.get("TOKEN", "")

def sign(url, server, credential, *wishes):
    body = json.dumps({"server": server, "credential": credential, "requests": list(wishes)})
    status, answer = send("POST", url, body, {"Content-Type": "application/json"})
    return status, (json.loads(answer).get("requests") if status == 200 else None)

def attack():
    url, server, credential, token = own()
    bucket = url.removesuffix("/sign") + "/" + PLAN["bucket"]
    refused, plain = {}, {}
    for key in PLAN["others"]:
        for method in ("GET", "PUT", "DELETE", "HEAD", "POST"):
            refused[f"{method} {key}"] = sign(url, server, credential, {"method": method, "key": key, "size": 2})[0]
            plain[f"{method} {key}"] = send(method, f"{bucket}/{urllib.parse.quote(key)}", b"{}" if method != "GET" else None)[0]
    GOT["refused"], GOT["plain"] = refused, plain
    GOT["other servers"] = [
        sign(url, name, one, {"method": "GET", "key": PLAN["mine"]})[0]
        for name in PLAN["servers"] for one in (credential, token, "", "0" * 64)
    ]
    GOT["token as credential"] = sign(url, server, token, {"method": "GET", "key": PLAN["mine"]})[0]

    # One's own requests, turned to something else.
    (request,) = sign(url, server, credential, {"method": "PUT", "key": PLAN["mine"], "size": 2})[1]
    (reading,) = sign(url, server, credential, {"method": "GET", "key": PLAN["mine"]})[1]
    address, headers = request["url"], request["headers"]
    less = {name: value for name, value in headers.items() if name != "If-None-Match"}
    GOT["turned"] = {
        "another key": send("PUT", address.replace(PLAN["mine"], PLAN["others"][0]), b"{}", headers)[0],
        "another method": send("DELETE", address, b"{}", headers)[0],
        "a read for a write": send("PUT", reading["url"], b"{}", headers)[0],
        "a write for a read": send("GET", address)[0],
        "a list": send("GET", reading["url"].replace("/" + PLAN["mine"], "/") + "&list-type=2")[0],
        "without its condition": send("PUT", address, b"{}", less)[0],
        "with another condition": send("PUT", address, b"{}", {**less, "If-Match": '"x"'})[0],
        "more bytes": send("PUT", address, b"{}" * 9, {**headers, "Content-Length": "18"})[0],
        "longer": send("PUT", re.sub("X-Amz-Expires=[0-9]+", "X-Amz-Expires=604800", address), b"{}", headers)[0],
        "a copy": send("PUT", address, b"{}", {**headers, "x-amz-copy-source": f"/{PLAN['bucket']}/{PLAN['others'][0]}"})[0],
    }
    GOT["own"] = [send("PUT", address, b"{}", headers)[0], send("PUT", address, b"[]", headers)[0]]
    GOT["read back"] = send("GET", reading["url"])[1]

if "plan.json" in os.listdir(Path(__file__).parent):
    try:
        attack()
    except Exception as error:
        GOT["broke"] = repr(error)
    Path(__file__).with_name("got.json").write_text(json.dumps(GOT))
    os._exit(0)
'''


class Site(StrictS3):
    """Two participants and another project, each with data that no other may have."""

    def __init__(self) -> None:
        super().__init__()
        self.mallory = self._claim("maze", MALLORY)
        self.alice = self._claim("maze", ALICE)
        self.other = self._claim("other", ALICE)
        self.warm_server = self._claim("maze", "~" + "0" * 20)
        for record in (self.mallory, self.alice, self.other, self.warm_server):
            self.keep(record)
        self.credential = self.variables(self.mallory)["CREDENTIAL"]
        put = self.documents.put
        put("project_master_list.json", b"the master list")
        put("maze/users/alice/answers/1.json", b"alice's answer")
        put("other/users/alice/answers/1.json", b"the other project's answer")
        put(f"maze/users/alice/trials/{self.alice.name}/3-trial.jsonl.gz", b"alice's recording")
        put("maze/users/mallory/answers/1.json", b"{}")
        put(handover_key("maze", self.warm_server.name), b'{"userId": "alice"}')
        self.before = dict(self.documents.kept)

    def _claim(self, project: str, user: str) -> Server:
        return server.new_attempt(
            study(id=project),
            user,
            1,
            nonce=f"nonce-{project}-{user}",
            settings=self.settings,
            now=self.now(),
        )

    def token(self, record: Server) -> str:
        return SecretCache(self.documents).get_or_create().token(record)

    @property
    def others(self) -> list[str]:
        """Keys that are not Mallory's: of existing documents, and of documents that could be added."""
        warm_server = handover_key("maze", self.warm_server.name)
        planted = [
            "maze/users/alice/answers/3.json", "other/users/mallory/answers/3.json", "maze/users/mallory/answers/4.json",
            "maze/users/mallory/participant.json", f"maze/users/alice/trials/{self.alice.name}/3-episode-0001.jsonl.gz",
            f"maze/users/mallory/trials/{self.alice.name}/3-trial.jsonl.gz", "maze/steps/debrief.html",
            "_slots/users/x/answers/3.json", "_slots/maze.json", "_warm/maze.json", "SSL/account.json", "invented",
            "maze/users/mallory/answers/../../alice/answers/3.json", "maze/users/mallory/answers/3.json/../1.json",
        ]  # fmt: skip
        kept = [key for key in self.before if key not in ("SSL/privkey.pem", "SSL/fullchain.pem")]
        return [*planted, *kept, KEY, warm_server]


@pytest.fixture
def site() -> Iterator[Site]:
    with Site().serving() as made:
        yield made


@pytest.fixture
def got(site: Site, tmp_path: Path) -> dict[str, Any]:
    """The data that the agent got, on a server that was started as start_server starts it."""
    (tmp_path / "agent.py").write_text(ATTACK)
    plan = {
        "bucket": BUCKET,
        "others": site.others,
        "mine": f"maze/users/{MALLORY}/answers/3.json",
        "servers": [site.alice.name, site.other.name, site.warm_server.name, ids.server_name(site.mallory.label, 2)],
    }
    (tmp_path / "plan.json").write_text(json.dumps(plan))
    told = {
        "PROJECT_ID": "maze", "USER_ID": MALLORY, "SERVER": site.mallory.name, "TOKEN": site.token(site.mallory), "GAME_STEPS": "3",
        "STORE": site.url, "CREDENTIAL": site.credential, "TRIAL": '{"game": "grid"}', "HOST": "127.0.0.1", "PORT": "0",
        "TLS": "off", "AGENT_DIR": str(tmp_path), "PYTHONPATH": str(ROOT),
    }  # fmt: skip
    inherited = {key: value for key, value in os.environ.items() if not key.startswith(("AWS_", "ECS_"))}
    done = subprocess.run(
        [sys.executable, "-m", "hippodrome.trial"], cwd=tmp_path, env={**inherited, **told}, capture_output=True, text=True, timeout=170, check=False,
    )  # fmt: skip
    assert (tmp_path / "got.json").exists(), done.stderr
    found: dict[str, Any] = json.loads((tmp_path / "got.json").read_text())
    assert "broke" not in found, found
    return found


def test_a_malicious_agent_gets_no_data_of_others(site: Site, got: dict[str, Any]) -> None:
    assert set(got["refused"].values()) <= {400, 403}
    assert len(got["refused"]) >= 5 * len(set(site.others))
    assert set(got["plain"].values()) == {403}
    assert set(got["other servers"]) == {403}
    assert got["token as credential"] == 403
    assert not any(secret in json.dumps(got) for secret in (*SECRETS, site.token(site.alice)))


def test_a_malicious_agents_own_requests_cannot_be_changed_to_others(got: dict[str, Any]) -> None:
    assert len(got["turned"]) == 10
    assert {name: status for name, status in got["turned"].items() if status != 403} == {}


def test_a_malicious_agent_may_store_its_own_answer_once(site: Site, got: dict[str, Any]) -> None:
    assert got["own"] == [200, 412]
    assert got["read back"] == "{}"
    changed = {key for key, kept in site.documents.kept.items() if site.before.get(key) != kept}
    assert changed == {f"maze/users/{MALLORY}/answers/3.json"}, "and nothing else was written, changed or removed"


def test_the_server_finds_no_secret_in_its_environment(got: dict[str, Any]) -> None:
    assert got["environment"] == []
