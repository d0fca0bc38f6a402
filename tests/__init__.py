"""The tests.

The package `slimevb`, which an example needs, installs a package `tests` too. Without this file, that would be found first.
"""
