"""The tests. The package `slimevb`, which an example needs, installs a package `tests` too: without this file it came first."""
