"""`make check`: what is wrong with a project, found before participants come."""
