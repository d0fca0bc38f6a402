"""What is tried before participants come, wherever a study is held: `make try` sends simulated ones on one machine,
`deploy doctor` on AWS; and which packages servers lack."""
