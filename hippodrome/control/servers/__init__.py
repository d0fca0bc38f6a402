"""Starts, names, replaces and ends servers, sweeps up what is left over, and signs requests for them."""
