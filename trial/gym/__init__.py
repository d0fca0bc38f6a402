"""Environments over a WebSocket: Gymie's messages, and a binary subprotocol for training (docs/gym.md)."""
