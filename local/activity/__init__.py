"""What the researcher's terminal shows while a study is held."""
