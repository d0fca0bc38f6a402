"""The control plane: records and their transitions in the middle, AWS (or one machine) at the edges."""
