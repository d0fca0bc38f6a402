"""The environment variables that a participant's server is started with.

`hippodrome/servers/start.py`, `hippodrome/aws/tasks.py`, `deploy/study/definition.py` and `local/` write them;
`trial/settings.py` reads them. The names are also those of HIPPO's and of earlier versions, and stay. All values are
text; durations are seconds.
"""

from __future__ import annotations

# Always given

PROJECT_ID = "PROJECT_ID"
SERVER = "SERVER"
"""The server's name, under which the recordings lie. Of a warm server: the name of its handover."""
TOKEN = "TOKEN"  # noqa: S105 - a variable's name
"""A secret. A client that shows it may play."""
GAME_STEPS = "GAME_STEPS"
"""Keys of the game steps, separated by commas: `3` or `2,4`."""
STORE = "STORE"
"""Where documents are stored: the address that signs requests (trial/recordings/presigned.py), or a folder."""

# The participant. A warm server reads both in its handover.

USER_ID = "USER_ID"
GROUP = "GROUP"
"""The participant's group, a whole number; empty in a study without groups. The researcher's agent may read it."""
WARM_SERVER = "SPARE"
"""`on`: a warm server."""
SESSION = "SESSION"
"""The session's id, if several participants play on this server. Then there are no USER_ID and no GROUP: the server
reads both in the session's document."""

# Given by the control plane

MATCHING = "MATCHING"
"""`match`: the server asks the function `match` of agent.py who plays with whom, while its session has no members."""

TRIAL = "TRIAL"
"""The `trial` section as JSON. Without it, ./config.yml is read."""
CREDENTIAL = "CREDENTIAL"
"""A secret. It is shown to the address in STORE."""
DEADLINE = "DEADLINE"
"""When the server ends in any case: seconds since the epoch."""
PLAIN_ORIGINS = "PLAIN_ORIGINS"
"""The origins of the project's front end, separated by spaces. Their pages need no token (plainClients)."""
SSL_FULLCHAIN = "SSL_FULLCHAIN"
SSL_PRIVKEY = "SSL_PRIVKEY"
"""The keys of the certificate and of its private key in STORE."""
TLS = "TLS"
"""`on` or `off`; on by default, and then SSL_FULLCHAIN and SSL_PRIVKEY are required."""
HOST = "HOST"
PORT = "PORT"
"""0: any free port. The server prints the port that it listens on."""
AGENT_DIR = "AGENT_DIR"
"""The folder of agent.py."""
SPOOL = "SPOOL"
"""The folder where recordings are written before they are stored."""
STOP_SECONDS = "STOP_SECONDS"
"""From SIGTERM to SIGKILL; 30 by default."""

# For tests and slow agents

IDLE_SECONDS = "IDLE_SECONDS"
GRACE_SECONDS = "GRACE_SECONDS"
START_SECONDS = "START_SECONDS"
STEP_SECONDS = "STEP_SECONDS"
"""For one step of the agent."""
HELLO_SECONDS = "HELLO_SECONDS"
RECORDINGS_FIRST_SECONDS = "RECORDINGS_FIRST_SECONDS"
"""An answer waits for so long until the recordings before it are stored; 120 by default."""
LINGER_SECONDS = "LINGER_SECONDS"
"""From the stored answer to the process's end."""
WARM_SERVER_SECONDS = "SPARE_SECONDS"
"""From one look for a handover to the next."""

SECRETS = (TOKEN, CREDENTIAL)
PARTICIPANT = (USER_ID, GROUP)


def group_text(group: int | None) -> str:
    """The value of GROUP."""
    return "" if group is None else str(group)
