"""Touches: shapes, gestures drawn from a seed, and their pressure movies."""
