"""Computes what a study will cost and what it has cost, from one table of prices."""
