"""RemoteEnv over TLS: the certificates that it trusts."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from hippodrome.gym import ConnectionLost, RemoteEnv
from testing.gym_server import gym_server
from tests.trial.test_trial_tls import put


@contextlib.contextmanager
def encrypted(url: str, folder: Path) -> Iterator[str]:
    """The address of a relay that speaks TLS in front of a server, for one connection at a time."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(folder / "fullchain.pem", folder / "privkey.pem")
    port = urlsplit(url).port
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    plain, _ = listener.accept()
                    with contextlib.suppress(OSError), context.wrap_socket(plain, server_side=True) as client:
                        relay(client, port)

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"wss://localhost:{listener.getsockname()[1]}/"
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            thread.join()


def relay(client: ssl.SSLSocket, port: int | None) -> None:
    """Carry requests and their answers in turns until the client goes."""
    with socket.create_connection(("127.0.0.1", port)) as server:
        while asked := client.recv(65536):
            server.sendall(asked)
            client.sendall(server.recv(65536))


@pytest.fixture(scope="module")
def url(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    folder = tmp_path_factory.mktemp("certificate")
    put(folder, 1)
    with gym_server() as server, encrypted(server.url, folder) as relayed:
        yield relayed, folder / "fullchain.pem"


def test_a_trusted_certificate_is_accepted(url: tuple[str, Path]) -> None:
    with RemoteEnv(url[0], "CartPole-v1", ca=str(url[1])) as env:
        env.reset(seed=1)
        assert env.step(1)[1] == 1.0


def test_an_untrusted_certificate_gets_a_sentence(url: tuple[str, Path]) -> None:
    with pytest.raises(ConnectionLost, match="certificate"):
        RemoteEnv(url[0], "CartPole-v1")


def test_a_wrong_file_of_certificates_gets_a_sentence(url: tuple[str, Path], tmp_path: Path) -> None:
    (tmp_path / "empty.pem").write_text("")
    for name in ("empty.pem", "nothing.pem"):
        with pytest.raises(ConnectionLost, match=r"no connection to wss://\S+: .+\."):
            RemoteEnv(url[0], "CartPole-v1", ca=str(tmp_path / name))
