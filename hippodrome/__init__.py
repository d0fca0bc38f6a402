"""Online human-AI experiments on AWS: a server for each participant, and none left behind."""
