"""What programs get at the path /gym of a trial: to watch, to advise, environments."""
