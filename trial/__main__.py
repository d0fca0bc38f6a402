"""`python -m trial`: the server of a participant or a session, as its environment says (protocol/environment.py)."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys

from protocol import environment, exits
from trial.server import assignment
from trial.server.preauth_limit import PortNotPermitted
from trial.server.server import TrialServer
from trial.settings import SettingsError, TrialSettings


async def _serve(settings: TrialSettings) -> tuple[int, bool]:
    server = TrialServer(settings)

    loop = asyncio.get_running_loop()
    serving = asyncio.create_task(server.run())
    await asyncio.sleep(0)  # run has begun: it can be ended
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, server.end, "asked to")
    return await serving, server.stuck


def main() -> int:
    """Run until the trial is over. 0: ended as it should; 1: could not serve; 2: wrong settings.

    3 and 4: no agent; 5: no port; see `protocol/exits.py`.
    """
    os.umask(0o077)  # recordings and answers, and what the agent writes, are the owner's alone
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(asctime)s %(levelname)s %(message)s")
    sys.dont_write_bytecode = (
        True  # for a changed agent.py of the same size and second Python would take the older code
    )
    sys.setswitchinterval(0.001)  # the agent's thread must not hold up the connection's for longer
    try:
        settings = TrialSettings.from_env(os.environ)
        for secret in environment.SECRETS:
            os.environ.pop(secret, None)  # the researcher's code has no use for them
        if not settings.assigned:
            assignment.set_environment(os.environ, None)
        status, stuck = asyncio.run(_serve(settings))
    except SettingsError as error:
        print(f"trial: {error}", file=sys.stderr)
        return 2
    except PortNotPermitted as error:
        logging.getLogger("trial").error("the server may not listen: %s", error)
        return exits.NO_PORT
    except Exception:
        logging.getLogger("trial").exception("the server cannot run")
        return 1
    if stuck:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)  # an ordinary exit could wait for code that never returns
    return status


if __name__ == "__main__":
    sys.exit(main())
