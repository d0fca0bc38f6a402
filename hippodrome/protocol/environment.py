"""The environment variables that a participant's server is started with.

`hippodrome/control/servers/start.py`, `hippodrome/control/aws/tasks.py`, `hippodrome/deployment/study/definition.py`
and `hippodrome/local/` write them; `hippodrome/trial/settings.py` reads them. All values are text; durations are
seconds.
"""

from __future__ import annotations

# Always given

PROJECT_ID = "PROJECT_ID"
SERVER = "SERVER"
"""The server's name, under which the recordings lie. For a warm server, its handover has this name."""
TOKEN = "TOKEN"  # noqa: S105 - a variable's name
"""A secret. A client that sends it may play on this server."""
GAME_STEPS = "GAME_STEPS"
"""Keys of the game steps, separated by commas: `3` or `2,4`."""
STORE = "STORE"
"""Where the server stores documents: a folder, or the address that signs requests (trial/recordings/store.py)."""

# The participant. A warm server reads its participant and group in its handover.

USER_ID = "USER_ID"
GROUP = "GROUP"
"""The participant's group, a whole number; empty in a study without groups. The researcher's agent may read it."""
WARM_SERVER = "WARM_SERVER"
"""`on` for a warm server, which has no participant when it starts."""
SESSION = "SESSION"
"""The session's id, if several participants play on this server. Such a server has no USER_ID and no GROUP: it reads
its members and their groups in the session's document."""

# Given by the control plane

MATCHING = "MATCHING"
"""`match` if the server asks the function `match` of agent.py who plays with whom, while its session has no members."""

TRIAL = "TRIAL"
"""The `trial` section as JSON. Without it, the server reads ./config.yml."""
ASSIGNMENT = "ASSIGNMENT"
"""`on` if the participants' games differ: the server reads their assignment (`protocol/assignment.py`)."""
CREDENTIAL = "CREDENTIAL"
"""A secret. The server sends it to the address in STORE."""
DEADLINE = "DEADLINE"
"""The time at which the server ends in any case: seconds since the epoch."""
PLAIN_ORIGINS = "PLAIN_ORIGINS"
"""The origins of the project's front end, separated by spaces. Their pages need no token (plainClients)."""
SSL_FULLCHAIN = "SSL_FULLCHAIN"
"""The key of the document in STORE that holds the certificate's chain."""
SSL_PRIVKEY = "SSL_PRIVKEY"
"""The key of the document in STORE that holds the certificate's private key."""
CERTIFICATE = "CERTIFICATE"
"""The address at which a server without a DNS name gets a certificate for its IPv4 address."""
TLS = "TLS"
"""`on` (the default) or `off`. With `on`, SSL_FULLCHAIN and SSL_PRIVKEY are required, or CERTIFICATE."""
HOST = "HOST"
PORT = "PORT"
"""The port, 5000 by default. With 0 the server takes any free port; it prints the port that it listens on."""
AGENT_DIR = "AGENT_DIR"
"""The folder of agent.py."""
SPOOL = "SPOOL"
"""The folder where recordings are written before they are stored."""
STOP_SECONDS = "STOP_SECONDS"
"""Seconds from SIGTERM to SIGKILL; 30 by default, and at least 15."""

LLM_KEY = "LLM_KEY"
"""A secret: the key of the language model that `trial.llm` names. On AWS the task definition says where Fargate reads
it; on one machine it is in the environment of `hippodrome run`."""

LLM_URL = "LLM_URL"
"""On one machine: the address of a stand-in for the language model, which takes the place of `trial.llm.url`."""

# For tests and slow agents

IDLE_SECONDS = "IDLE_SECONDS"
"""Seconds for which no participant is connected before the server ends; 600 by default."""
GRACE_SECONDS = "GRACE_SECONDS"
"""Seconds for which the server waits at least for a participant who was connected before; 60 by default."""
START_SECONDS = "START_SECONDS"
"""Seconds in which the agent must start; 300 by default."""
STEP_SECONDS = "STEP_SECONDS"
"""Seconds in which the agent must take a step; 30 by default."""
HELLO_SECONDS = "HELLO_SECONDS"
"""Seconds in which a client that has connected must send its first message; 10 by default."""
STALLED_SECONDS = "STALLED_SECONDS"
"""Seconds for which a client may leave a frame without acknowledgement before it counts as lost or hidden; 3 by
default."""
RECORDINGS_FIRST_SECONDS = "RECORDINGS_FIRST_SECONDS"
"""Seconds for which an answer waits at most until the recordings before it are stored; 120 by default."""
LINGER_SECONDS = "LINGER_SECONDS"
"""Seconds from when the answer is stored until the process ends; 2 by default."""
ASSIGNMENT_SECONDS = "ASSIGNMENT_SECONDS"
"""Seconds after which a server without participants looks again for the document that names them (its handover, or its
session's document); 20 by default."""

SECRETS = (TOKEN, CREDENTIAL, LLM_KEY)
PARTICIPANT = (USER_ID, GROUP)


def group_text(group: int | None) -> str:
    """Return the value that the variable GROUP has for this group."""
    return "" if group is None else str(group)
