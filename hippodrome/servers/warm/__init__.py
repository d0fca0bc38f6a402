"""Warm servers (`warmServers`): the pool of a project, and the handover of one to a participant."""
