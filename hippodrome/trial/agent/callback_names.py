"""The names of the callbacks, which are methods of the researcher's agent (`callbacks.py`)."""

from __future__ import annotations

SESSION_START = "on_session_start"
SESSION_END = "on_session_end"
EPISODE_START = "on_episode_start"
EPISODE_END = "on_episode_end"
TICK = "on_tick"
FEEDBACK = "on_feedback"
JOIN = "on_join"
LEAVE = "on_leave"
RETURN = "on_return"
FORM = "on_form"
REPLY = "reply"
MODERATE = "moderate"
TALK_METHODS = (REPLY, MODERATE)
"""Methods for what is said (`replies.py`). They run on threads of their own."""
NAMES = (
    SESSION_START,
    SESSION_END,
    EPISODE_START,
    EPISODE_END,
    TICK,
    FEEDBACK,
    JOIN,
    LEAVE,
    RETURN,
    FORM,
)
