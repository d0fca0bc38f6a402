"""WebSocket connections to participants: what is sent, and how messages are read."""
