"""Puts a study on AWS: its image, task definition, pages, registration and links."""
