"""Bots are simulated participants. They try a study before people come: `try` sends them through a study on one
machine, `hippodrome doctor --rehearse --play` on AWS."""
