"""Every AWS call of every function, judged by its role in the template."""
