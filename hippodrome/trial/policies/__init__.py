"""The policies that play for players of an environment: ONNX files, `random`, `idle`, and classes of agent.py."""
