"""Stands for `python -m hippodrome.trial` where many are started: it imports little, plays when it is told to, and keeps the store.

`GET /play` records a game and writes its answer, as the trial does, and ends; `GET /begin` only begins a recording.
On SIGTERM what was begun is stored, as the trial does.
"""

import os
import signal
import socket
import sys

told = os.environ
project = told["PROJECT_ID"]
begun: list[str] = []


def whose() -> tuple[str, str]:
    """Return the participant and the server's name, also for a server that was warm."""
    if told.get("USER_ID"):
        return told["USER_ID"], told["SERVER"]
    import json

    with open(f"{told['STORE']}/{project}/handovers/{told['SERVER']}.json") as document:
        given = json.load(document)
    return given["userId"], given["server"]


def create(place: str, text: str) -> None:
    os.makedirs(os.path.dirname(place), exist_ok=True)
    unfinished = f"{os.path.dirname(place)}/.{os.getpid()}.new"
    with open(unfinished, "w") as file:
        file.write(text)
    if not os.path.exists(place):
        os.link(unfinished, place)
    os.unlink(unfinished)


def begin() -> None:
    user, server = whose()
    part = f"{told['SPOOL']}/{project}/users/{user}/trials/{server}/2-episode-0001.jsonl.gz.part"
    os.makedirs(os.path.dirname(part), exist_ok=True)
    with open(part, "w") as file:
        file.write(f"what {user} played on {server}")
    begun.append(part)


def store() -> None:
    while begun:
        part = begun.pop()
        with open(part) as file:
            create(part.replace(told["SPOOL"], told["STORE"]).removesuffix(".part"), file.read())
        os.unlink(part)


def end(*_: object) -> None:
    store()
    os._exit(0)


signal.signal(signal.SIGTERM, end)
listening = socket.create_server(("127.0.0.1", 0))
print('{"port": %d}' % listening.getsockname()[1], flush=True)  # noqa: UP031 - json is slow to import
while True:
    connection, _ = listening.accept()
    asked = connection.recv(4096).split(b" ")[1:2]
    if asked in ([b"/begin"], [b"/play"]):
        begin()
    if asked == [b"/play"]:
        store()
        answers = f"{told['STORE']}/{project}/users/{whose()[0]}/answers/2.json"
        create(
            answers,
            '{"step": "2", "page": "game", "group": null, "answered": "", "answers": {"score": 1}, "schema": 1}',
        )
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 0\r\nConnection: close\r\n\r\n")
    connection.close()
    if asked == [b"/play"]:
        sys.exit(0)
