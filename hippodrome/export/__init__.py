"""`data`: converts answers and recordings into tables and datasets, from a bucket or a folder with its keys."""
