"""A simulated AWS on a virtual clock: late and repeated events, quotas, Spot, crashes. The same seed gives the same run."""
