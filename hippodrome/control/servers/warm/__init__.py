"""Warm servers (`warmServers`): the pool of a project, and the handover of a warm server to a participant."""
