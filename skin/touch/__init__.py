"""Touches: labels, shapes, gestures and movies of pressure."""
