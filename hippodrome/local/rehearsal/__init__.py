"""`try`: simulated participants walk through a whole study, and all that they sent is looked for in the data."""
