"""The command line for AWS: installs Hippodrome, registers studies, shows servers and costs, fetches data, removes."""
