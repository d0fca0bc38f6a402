"""Pictures of a game: frames (pixels) and scenes (objects), and their bytes on the wire."""
