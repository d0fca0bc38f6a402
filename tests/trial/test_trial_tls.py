"""An encrypted server, and its certificate's renewal."""

import asyncio
import datetime
import ssl

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from hippodrome.trial.recordings.store import FolderStore
from hippodrome.trial.server.listener import Certificate
from hippodrome.trial.settings import TrialSettings


def certificate(serial):
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(serial)
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    return made.public_bytes(serialization.Encoding.PEM), private


def put(folder, serial):
    folder.mkdir(parents=True, exist_ok=True)
    chain, private = certificate(serial)
    (folder / "fullchain.pem").write_bytes(chain)
    (folder / "privkey.pem").write_bytes(private)
    return chain


KEYS = {"SSL_FULLCHAIN": "ssl/fullchain.pem", "SSL_PRIVKEY": "ssl/privkey.pem", "TLS": "on"}


async def test_a_participant_plays_over_tls(launch, open_client, grid, tmp_path):
    chain = put(tmp_path / "store" / "ssl", 1)
    server = launch(grid(30), {"maxEpisodes": 9, "startingFrameRate": 60, "ui": {"stop": True}}, **KEYS)
    trusted = ssl.create_default_context(cadata=chain.decode())
    async with open_client(f"wss://localhost:{server.port}/", ssl=trusted) as client:
        await client.hello()
        await client.say(command="start")
        await client.until(lambda: len(client.frames) > 10 and client.state["episode"] > 1)
        await client.stop()
        assert client.done["episodes"] >= 1
    assert server.wait() == 0


async def test_a_running_server_takes_a_renewed_certificate(tmp_path):
    put(tmp_path / "ssl", 1)
    required = {
        "PROJECT_ID": "a",
        "USER_ID": "b",
        "SERVER": "c",
        "TOKEN": "d",
        "GAME_STEPS": "1",
        "STORE": "e",
        "TRIAL": "{}",
    }
    served = Certificate(TrialSettings.from_env({**required, **KEYS}), FolderStore(tmp_path))
    assert served.load() is True
    assert served.load() is False
    server = await asyncio.start_server(lambda r, w: w.close(), "127.0.0.1", 0, ssl=served.context)
    port = server.sockets[0].getsockname()[1]
    async with server:
        serials = []
        for number in (1, 2):
            if number == 2:
                put(tmp_path / "ssl", 2)
                assert served.load() is True
            pem = await asyncio.to_thread(ssl.get_server_certificate, ("127.0.0.1", port))
            serials.append(x509.load_pem_x509_certificate(pem.encode()).serial_number)
        assert serials == [1, 2]


def test_a_missing_certificate_ends_the_process(tmp_path, launch):
    import pytest

    with pytest.raises(AssertionError, match="certificate"):
        launch(**KEYS)
