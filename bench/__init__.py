"""What it costs: each row with its yardstick, measured in the same run."""
