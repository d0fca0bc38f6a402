"""Recordings and answers: written, spooled, stored, and read again by the next server."""
