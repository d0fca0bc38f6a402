"""Answers and recordings as tables and datasets, read from a bucket or from a folder with the same keys."""
