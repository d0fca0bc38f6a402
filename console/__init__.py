"""What commands share that people run in a terminal: output, problems, exit codes, numbers as people read them."""
