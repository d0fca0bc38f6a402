"""What the researcher's terminal shows while a study runs."""
