"""A project's limits: the rules, and the slots that participants and servers hold."""
