"""Where participants who play together wait for each other, and who plays with whom (`project.players`)."""
