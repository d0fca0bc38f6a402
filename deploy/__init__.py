"""`hippodrome`: the command line for AWS, of hippodrome/deployment/."""
