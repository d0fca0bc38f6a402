"""Exit codes of `python -m trial` that the control plane tells apart."""

from __future__ import annotations

NO_AGENT = 3
"""The agent cannot be started. The participant may have had the server's address already."""
LATE_AGENT = 4
"""The agent was not started within the time allowed."""
NO_PORT = 5
"""The system does not let the server listen on its port."""
