"""The command line for AWS: stack, certificate, projects, what runs, what it costs, the data, and away again."""
