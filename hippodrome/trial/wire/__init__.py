"""WebSocket connections to participants: sends pictures and messages, and reads clients' messages."""
