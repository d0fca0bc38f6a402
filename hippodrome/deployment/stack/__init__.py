"""The parts of an installation on AWS: its stack, buckets, certificate and policies, and what blocks their changes."""
