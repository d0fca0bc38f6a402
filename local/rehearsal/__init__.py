"""`make try`: simulated participants walk through a whole study, and somebody looks whether all of it arrived."""
