"""Recordings and answers: written to a spool, stored, and read by the server that replaces a lost one."""
