"""Records in documents: the repository, the cache of projects, compare-and-swap, and the installation's secret."""
