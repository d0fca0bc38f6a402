"""The process of a participant's server: its life, its port, who gets in."""
