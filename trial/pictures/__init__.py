"""Pictures of a game: frames, and how they become bytes."""
