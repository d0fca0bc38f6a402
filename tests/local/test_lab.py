"""`hippodrome run --host`: a lab's server, whose studies other machines open, play and list."""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import ssl
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlencode, urlsplit

import httpx
import pytest

from hippodrome import cli
from hippodrome.console.problem import Exit
from hippodrome.local.backend.authority import Authority
from testing.processes import ROOT
from testing.waiting import until
from tests.local.conftest import Local, write_study
from tests.local.lab_clients import own_link, send

Make = Callable[..., Local]
HOST = "127.0.0.7"
JOIN = r"(https?://\S+/join/{}\?key=[0-9a-f]+)"


def hold(local: Make, *options: str, **study: object) -> Local:
    one = local(**study)
    one.begin("--host", HOST, *options)
    one.url = one.wait_for_text(r"(https?://[\w.]+:\d+)/join")[1]
    return one


def link(one: Local, project: str = "quick") -> str:
    return one.wait_for_text(JOIN.format(project))[1]


# Who gets in


def test_each_browser_that_opens_the_link_is_a_new_participant_with_a_signed_link(local: Make) -> None:
    one = hold(local)
    first, ada = own_link(link(one) + "&seat=3")
    _, bob = own_link(link(one))
    assert ada != bob
    assert parse_qs(urlsplit(first).query)["seat"] == ["3"]
    with httpx.Client() as client:
        assert "hello" in client.get(first).text
        assert not client.cookies, "the link alone says who it is"
        signed = parse_qs(urlsplit(first).query)["signature"][0]
        for query in ({"userId": ada}, {"userId": "made-up", "signature": signed}, {}):
            assert client.get(f"{one.url}/next?{urlencode({'projectId': 'quick', **query})}").status_code == 403
        for wrong in (f"{one.url}/join/quick", f"{one.url}/join/quick?key={signed}", f"{one.url}/join/other?key=x"):
            assert client.get(wrong).status_code == 403
        chosen = client.get(f"{link(one)}&userId=boss")
        assert "userId=boss" not in chosen.headers["location"], "nobody chooses an id"
    assert one.end() == 0
    assert [path.name for path in (one.data / "quick" / "users").iterdir()] == [ada]


def test_the_list_shows_every_study_to_those_who_hold_its_key(local: Make, tmp_path: Path) -> None:
    second = write_study(tmp_path / "second", frames=20)
    config = second / "config.yml"
    config.write_text(config.read_text().replace("id: quick", "id: slow").replace("A quick study", "Dots <& dashes>"))
    one = hold(local, str(second))
    shown = one.wait_for_text(r"(http://\S+/lab\?key=[0-9a-f]+)")[1]
    page = httpx.get(shown).text
    assert "A quick study" in page
    assert "Dots &lt;&amp; dashes&gt;" in page
    assert page.count("<svg") == 2
    for project in ("quick", "slow"):
        assert link(one, project) in page
    assert httpx.get(shown[:-1]).status_code == 403
    assert httpx.get(f"{one.url}/lab").status_code == 403
    reports = [asyncio.run(send(link(one, project), 1))[0] for project in ("quick", "slow")]
    assert [(report["finished"], report["errors"]) for report in reports] == [(True, [])] * 2
    assert {path.name for path in one.data.iterdir()} >= {"quick", "slow"}
    assert one.end() == 0


def test_a_study_that_lies_in_the_data_and_is_not_served_cannot_be_opened(local: Make) -> None:
    one = local()
    (one.folder / "steps" / "map.svg").write_text("<svg xmlns='http://www.w3.org/2000/svg'/>")
    one.run()
    assert httpx.get(f"{one.url}/next?projectId=quick&userId=ada").status_code == 200
    assert one.end() == 0
    config = one.folder / "config.yml"
    config.write_text(config.read_text().replace("id: quick", "id: another"))
    one.begin("--host", HOST)
    one.url = one.wait_for_text(r"(http://[\w.]+:\d+)/join")[1]
    for name in ("projectId", "projectID", "projectid", "project_id"):
        assert httpx.get(f"{one.url}/next?{name}=quick&userId=ada").status_code == 404
    assert httpx.get(f"{one.url}/steps/another/map.svg").status_code == 200
    assert httpx.get(f"{one.url}/steps/quick/map.svg").status_code == 404
    for relay in ("start", "stop"):
        named = {"projectId": "quick", "userId": "ada"}
        assert "no such study here" in httpx.get(f"{one.url}/{relay}", params=named).text
        for body in ({"data": named}, {"json": named}):
            assert "no such study here" in httpx.post(f"{one.url}/{relay}", **body).text
        assert httpx.post(f"{one.url}/{relay}", json={**named, "projectId": "another"}).status_code == 403
    assert one.end() == 0


# Playing


def test_participants_reach_their_games_at_the_port_of_the_pages(local: Make) -> None:
    one = hold(local)
    (report,) = asyncio.run(send(link(one), 1))
    assert (report["finished"], report["errors"]) == (True, [])
    ((address,),) = report["played"]
    assert re.fullmatch(rf"ws://{HOST}:{urlsplit(one.url).port}/game/s[a-z2-7]{{20}}-1/", address)
    assert f"{HOST}:" not in one.text().partition("Ctrl-C")[2], "lines on servers name no address that opens nothing"
    assert one.end() == 0


def test_with_tls_pages_and_games_have_a_certificate_of_this_address(local: Make) -> None:
    one = hold(local, "--tls")
    authority = one.place / ".hippodrome" / f"tls-{HOST}" / "authority.pem"
    (report,) = asyncio.run(send(link(one), 1, ssl.create_default_context(cafile=authority)))
    assert (report["finished"], report["errors"]) == (True, [])
    ((address,),) = report["played"]
    assert address.startswith(f"wss://{HOST}:")
    assert one.end() == 0


def test_a_lab_may_have_a_certificate_of_its_own(local: Make, tmp_path: Path) -> None:
    authority = Authority(tmp_path / "university", HOST)
    both = authority._certify(["localhost", HOST])
    for name in ("chain.pem", "key.pem"):
        (tmp_path / name).write_bytes(both)
    one = hold(local, "--certificate", str(tmp_path / "chain.pem"), "--key", str(tmp_path / "key.pem"))
    trusted = ssl.create_default_context(cafile=authority.certificate)
    own, _ = own_link(link(one), trusted)
    assert own.startswith(f"https://{HOST}:")
    assert one.end() == 0


def _state_at_the_game(joining: str) -> dict[str, Any]:
    """Answer the page before the game as a new participant. Return the state of their server, once it is decided."""
    own, _ = own_link(joining)
    with httpx.Client(headers={"accept": "application/json"}) as client:
        shown = client.get(own).json()
        client.post(own, json={"hippodrome-step": "1", "hippodrome-ticket": shown["ticket"], "word": "x"})
        until(lambda: client.get(own).json()["state"] not in ("queued", "starting", "naming"))
        found: dict[str, Any] = client.get(own).json()
        return found


def test_a_lab_runs_no_more_games_at_once_than_the_study_allows(local: Make) -> None:
    one = local()
    config = one.folder / "config.yml"
    config.write_text(config.read_text().replace("  maxRuntime: 5", "  maxRuntime: 5\n  maxServers: 1"))
    one.begin("--host", HOST)
    states = [_state_at_the_game(link(one)) for _ in range(2)]
    assert [(state["state"], state["reason"]) for state in states] == [("ready", None), ("failed", "full")]
    assert one.end() == 0


NAMESPACES = """
set -e
ip link set lo up
unshare --net sleep 600 &
clients=$!
for _ in $(seq 50); do
    [ "$(readlink /proc/$clients/ns/net)" != "$(readlink /proc/self/ns/net)" ] && break; sleep 0.1
done
ip link add lab type veth peer name clients netns $clients
ip addr add 10.86.0.1/24 dev lab && ip link set lab up
there="nsenter --target $clients --net"
$there ip addr add 10.86.0.2/24 dev clients && $there ip link set clients up
$PYTHON -m hippodrome run "$STUDY" --data data --port 8000 --host 0.0.0.0 > output.txt 2>&1 &
lab=$!
for _ in $(seq 300); do grep -q Ctrl-C output.txt && break; sleep 0.1; done
status=0
$there $PYTHON -m tests.local.lab_clients "$(grep -o 'http://[^ ]*/join/[^ ]*' output.txt)" 10 > reports.json || status=$?
kill -INT $lab; wait $lab
kill $clients
exit $status
"""
"""The lab's server in one network namespace and its clients in another: two hosts, with a cable between them."""
OUTER = ["unshare", "--user", "--map-root-user", "--net"]


def _no_namespaces() -> str:
    missing = [tool for tool in ("unshare", "nsenter", "ip") if shutil.which(tool) is None]
    if missing:
        return f"needs {', '.join(missing)}"
    probe = [*OUTER, "ip", "link", "add", "lab", "type", "veth", "peer", "name", "clients"]
    done = subprocess.run(probe, capture_output=True, check=False)
    return "needs network namespaces with pairs of devices" if done.returncode else ""


@pytest.mark.skipif(bool(_no_namespaces()), reason=_no_namespaces())
def test_ten_clients_of_another_host_play(tmp_path: Path) -> None:
    study = write_study(tmp_path / "study", frames=20)
    config = study / "config.yml"
    config.write_text(config.read_text().replace("  maxRuntime: 5", "  maxRuntime: 5\n  maxServers: 10"))
    environment = {**os.environ, "PYTHON": sys.executable, "STUDY": str(study), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [*OUTER, "sh", "-c", NAMESPACES], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    told = (tmp_path / "output.txt").read_text()
    assert done.returncode == 0, done.stderr + told
    assert "every machine that can reach http://10.86.0.1:8000 can open it" in told
    assert "Plain HTTP" in told
    assert "Set maxServers" not in told
    reports = json.loads((tmp_path / "reports.json").read_text())
    assert [(report["finished"], report["errors"]) for report in reports] == [(True, [])] * 10
    played = {address for report in reports for addresses in report["played"] for address in addresses}
    assert {urlsplit(address).netloc for address in played} == {"10.86.0.1:8000"}
    assert len(played) == 10, "each has a server of their own"
    users = tmp_path / "data" / "quick" / "users"
    assert {path.name for path in users.iterdir()} == {report["user"] for report in reports}
    assert len([*users.glob("*/answers/2.json")]) == 10


# What is refused


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--host", "203.0.113.9"], "This machine has no address 203.0.113.9."),
        (["--host", "no such host"], "This machine has no address no such host."),
        (["--host", "0.0.0.0", "--names", "hash", "--tls"], "--names has no effect with --host"),
        (["--host", "0.0.0.0", "--certificate", "a.pem"], "--certificate and --key belong together."),
        (["--certificate", "a.pem", "--key", "a.pem"], "--certificate needs --host"),
        (["SECOND"], "Several studies at once need --host"),
    ],
)
def test_options_that_make_no_lab_are_refused_on_stderr(
    options: list[str], says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = [write_study(tmp_path / name) for name in ("first", "second")]
    options = [str(folders[1]) if option == "SECOND" else option for option in options]
    assert cli.main(["run", str(folders[0]), "--data", str(tmp_path / "data"), *options]) == Exit.MISUSE
    said = capsys.readouterr()
    assert (said.out, says in said.err) == ("", True), said.err
    assert not (tmp_path / "data").exists()


def test_two_studies_with_one_id_are_refused(local: Make, tmp_path: Path) -> None:
    one = local()
    one.begin("--host", HOST, str(write_study(tmp_path / "second")))
    one.wait_for_text("Two studies have the same id")
    assert one.process
    assert one.process.wait(30) == Exit.FAILED


def test_a_study_that_lets_clients_in_without_a_token_is_refused_in_a_lab(local: Make) -> None:
    one = local()
    config = one.folder / "config.yml"
    keys = "plainClients: true\n  frontEnd: [http://localhost:3000]\n  subdomain: userId"
    config.write_text(config.read_text().replace("live: true", f"live: true\n  {keys}"))
    one.begin("--host", HOST)
    one.wait_for_text(r"project.plainClients is true, which a lab's server \(--host\) does not allow")
    assert "project.subdomain is userId, which a lab's server (--host) does not allow" in one.text()
    assert "installation" not in one.text()
    assert one.process
    assert one.process.wait(30) == Exit.FAILED
