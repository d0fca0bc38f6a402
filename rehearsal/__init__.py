"""Simulated participants, wherever a study is held: `make try` sends them on one machine, `deploy doctor` on AWS."""
