"""Players of an environment that are no humans: ONNX files, `random`, `idle`, and classes of agent.py."""
