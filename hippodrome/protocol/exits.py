"""The exit codes of `python -m hippodrome.trial` that the control plane distinguishes."""

from __future__ import annotations

NO_AGENT = 3
"""The agent cannot be started. The participant may already have got the server's address."""
LATE_AGENT = 4
"""The agent was not started within START_SECONDS."""
NO_PORT = 5
"""The system does not let the server listen on its port."""
NO_CERTIFICATE = 6
"""The server got no certificate for its address."""
