"""Simulate a soft, sparsely sensed robot skin and learn what touches it."""

__version__ = "0.1.0"
