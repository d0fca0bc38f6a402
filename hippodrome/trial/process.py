"""The process of a trial server: its settings, its signals, and its exit status."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from concurrent.futures import Future

from hippodrome.protocol import environment, exits
from hippodrome.trial.server import assignment
from hippodrome.trial.server.listener import PortNotPermitted
from hippodrome.trial.server.own_certificate import CertificateAndKey, NoCertificate
from hippodrome.trial.server.server import TrialServer
from hippodrome.trial.settings import SettingsError, TrialSettings


async def _serve(settings: TrialSettings, own: Future[CertificateAndKey] | None) -> tuple[int, bool]:
    server = TrialServer(settings, own)

    loop = asyncio.get_running_loop()
    serving = asyncio.create_task(server.run())
    await asyncio.sleep(0)  # lets `run` begin: before that, `end` would find nothing to end
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, server.end, "asked to")
    return await serving, server.stuck


def run(own: Future[CertificateAndKey] | None) -> int:
    """Run the server, and return the process's exit status.

    `own`: the certificate for the server's own address, if it gets one. 0: the server ended without an error; 1: with
    an error; 2: wrong settings; 3 to 6: see `hippodrome/protocol/exits.py`.
    """
    os.umask(0o077)  # only this user may read recordings, answers, and the files that the agent writes
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s")
    # Python uses cached bytecode if the source has the same size and was changed in the same second. An agent.py that
    # was edited twice within a second would run in its first version.
    sys.dont_write_bytecode = True
    sys.setswitchinterval(0.001)  # seconds for which the agent's thread may keep the event loop's thread waiting
    try:
        settings = TrialSettings.from_env(os.environ)
        for secret in environment.SECRETS:
            os.environ.pop(secret, None)  # so that the researcher's code cannot read them there
        if not settings.assigned:
            assignment.set_environment(os.environ, None)
        status, stuck = asyncio.run(_serve(settings, own))
    except SettingsError as error:
        print(f"trial: {error}", file=sys.stderr)
        return 2
    except PortNotPermitted as error:
        logging.getLogger("trial").error("the server may not listen: %s", error)
        return exits.NO_PORT
    except NoCertificate as error:
        logging.getLogger("trial").error("the server has no certificate: %s", error)
        return exits.NO_CERTIFICATE
    except Exception:
        logging.getLogger("trial").exception("the server cannot run")
        return 1
    if stuck:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # an ordinary exit would wait for the researcher's code, which may never return
    return status
