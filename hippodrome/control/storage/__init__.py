"""Stores records in documents: the repository, the cache of projects, compare-and-swap, the installation's secret."""
