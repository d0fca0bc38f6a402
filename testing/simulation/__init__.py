"""A truthful AWS on a virtual clock: late and repeated events, quotas, Spot, crashes. The same seed is the same run."""
