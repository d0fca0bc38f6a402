"""`python -m deploy`: the command line for AWS, of hippodrome/deployment/."""
