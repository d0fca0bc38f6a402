"""The lobby: participants who play together (`project.players`) wait for each other, and are matched."""
