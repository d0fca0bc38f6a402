"""The way to the language model: a loopback address that adds the key, counts, caps, and records."""
