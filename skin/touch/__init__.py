"""What touches the skin: shapes, gestures drawn from a seed, and their pressure movies."""
