"""The researcher's code: loaded, called on a thread of its own, and its errors reported."""
