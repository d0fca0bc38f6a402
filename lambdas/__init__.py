"""One file per Lambda function: read the event, call `hippodrome`, shape the reply; nothing else."""
