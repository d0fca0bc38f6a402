"""The parts of an installation on AWS: its stack, buckets, certificate, policies, and what stands in their way."""
